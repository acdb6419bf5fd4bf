"""Releases of networks on a fleet: what its proxy offers vehicles, and what these report."""
