"""Verification of a candidate: checks of its files, and paired tests against the driving network."""
