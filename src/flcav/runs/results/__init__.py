"""Records of results: of the steps of a run, and of the run."""
