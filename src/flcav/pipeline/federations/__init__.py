"""Federations of a run: the records of their rounds, as results, tables and curves."""
