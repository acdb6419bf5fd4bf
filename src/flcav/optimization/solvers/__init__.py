"""Solvers of allocation problems over whole samples and rounds, with proven lower bounds."""
