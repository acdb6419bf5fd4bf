"""Charts of federations."""
