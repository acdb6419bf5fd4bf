"""Ray casting with Embree 4."""
