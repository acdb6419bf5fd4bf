"""Verifiers of plans and placements that share no code with the solvers: they recompute what a certificate states."""
