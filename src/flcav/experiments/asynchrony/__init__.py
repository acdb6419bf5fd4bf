"""Rounds that do not wait for stragglers, against rounds that do, and rounds with a deadline."""
