"""Extras of a run: a folder per extra, with its part of the recipe, checks, steps, rows and section of the report."""
