"""How an aggregator combines updates."""
