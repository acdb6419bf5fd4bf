"""LiDAR: beams, returns, weather, motion during a spin."""
