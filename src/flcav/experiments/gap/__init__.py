"""Comparison of federations and label sources by the share of the oracle's gain that they reach."""
