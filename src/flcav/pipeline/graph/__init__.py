"""The dependency graph of a run's steps, for every task, region and arm; arms that agree on a step share it."""
