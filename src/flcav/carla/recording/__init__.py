"""CARLA as a source of frames, by documented calls of its Python client (`carla` 0.9.16, extra `carla`)."""
