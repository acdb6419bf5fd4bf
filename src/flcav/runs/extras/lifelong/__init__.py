"""Lifelong learning: a fleet drives through conditions one after another, and learns where its network errs."""
