"""HTML pages of runs, plans, releases and drives."""
