"""Verification of a candidate: what its files say, and paired tests beside the network that drives."""
