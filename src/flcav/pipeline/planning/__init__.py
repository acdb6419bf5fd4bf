"""Plans under both uplink budgets: before a run, between its stages, and after each of their rounds."""
