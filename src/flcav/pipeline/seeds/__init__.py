"""Several runs: means over seeds, the comparison of two runs, and runs that measure a learning history."""
