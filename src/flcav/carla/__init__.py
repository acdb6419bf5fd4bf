"""CARLA: our world for its clients."""
