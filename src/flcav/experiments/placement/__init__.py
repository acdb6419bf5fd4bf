"""Proof of placement by learning: what vehicles learn from a sensor on each pole, against what it covers."""
