"""Distillation, as losses of a detector: from the road average of boxes, and from the network that it began with."""
