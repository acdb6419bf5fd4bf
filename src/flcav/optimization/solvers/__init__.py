"""Exact solvers of allocation problems, with certificates."""
