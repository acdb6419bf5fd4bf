"""Redundant tasks: as many as scenarios are complex, against an even split."""
