"""CARLA, the simulator (Dosovitskiy et al., CoRL 2017): its coordinates, and what speaks with it."""
