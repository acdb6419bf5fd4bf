"""Extras of a run: each folder is one, with its part of the recipe, checks, steps, rows and section of the report."""
