"""Microscopic traffic simulation by SUMO: demand, the simulation process, and the trace of the run."""
