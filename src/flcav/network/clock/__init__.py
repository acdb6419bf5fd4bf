"""Simulated clock of federated rounds: durations from message sizes, radio links and computing times."""
