"""Radar simulation: cross-sections, resolution cells, detection."""
