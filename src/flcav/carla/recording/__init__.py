"""CARLA as a source of frames, by its own client and documented calls alone (`carla` 0.9.16, extra `carla`)."""
