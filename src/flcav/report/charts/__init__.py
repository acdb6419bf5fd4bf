"""Charts of runs, plans, learning curves and studies."""
