"""Traffic: demand, SUMO, and the trace of everybody that it gives."""
