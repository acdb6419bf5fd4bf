"""Recorded frames on disk: write, read, check."""
