"""LiDAR simulation: beam patterns, ray casting, returns and their intensity, fog and rain, rolling spins."""
