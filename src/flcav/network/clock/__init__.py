"""Simulated clock of federated rounds: from bytes, radio links and speeds to seconds."""
