"""Attacks on a federation of the weather task: Byzantine clients, and a curious server."""
