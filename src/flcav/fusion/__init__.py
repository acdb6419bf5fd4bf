"""Combining what several agents saw."""
