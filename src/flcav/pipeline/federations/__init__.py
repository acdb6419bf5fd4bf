"""Federations of a run: stage II alone, checkpoints, messages and network of the rounds, their records."""
