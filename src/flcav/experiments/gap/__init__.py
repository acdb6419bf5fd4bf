"""The comparison of federations and label sources by the share of what ground truth gains."""
