"""The sensors of CARLA's clients: what each sends at one tick, as bytes."""
