"""Dynamics of vehicles and walkers under control: the vehicle model, contacts between boxes, and the town's obstacles."""
