"""Cameras: lens, exposure and tone, infrared."""
