"""CARLA: a source of frames from its simulator, and a server of its protocol on a live world of flcav."""
