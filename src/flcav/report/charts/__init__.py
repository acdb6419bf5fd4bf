"""Charts of runs, plans, curves and studies."""
