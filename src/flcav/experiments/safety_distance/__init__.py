"""Uncertainty of perception as safety distance."""
