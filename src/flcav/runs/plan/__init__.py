"""Plans under both uplink budgets: before a run and between its stages."""
