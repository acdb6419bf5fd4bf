"""Lifelong learning: with replay, without, and doing nothing."""
