"""Results over the seeds of a run: their means, and the comparison of two runs."""
