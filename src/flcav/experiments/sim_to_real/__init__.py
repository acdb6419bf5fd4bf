"""The detector trained in simulation, on real sweeps."""
