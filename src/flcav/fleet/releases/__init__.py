"""Releases of networks on a fleet: the files that its proxy serves to vehicles, and the vehicles' reports."""
