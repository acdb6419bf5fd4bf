"""Sim-to-real transfer: simulated clouds compared with KITTI's, and the simulation-trained detector on KITTI."""
