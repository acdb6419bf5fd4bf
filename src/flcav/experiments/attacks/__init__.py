"""Attacks on a federation of the weather task: clients that lie, and a server that reads."""
