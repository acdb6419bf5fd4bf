"""Dynamics of vehicles and walkers under control: vehicle model, contacts of boxes, the ground and its obstacles."""
