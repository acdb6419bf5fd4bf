"""Redundant tasks: their number by the complexity of a scenario, against an even split."""
