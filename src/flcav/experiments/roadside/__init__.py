"""Experiments on roadside perception: the trained detector, the road average of labels, registered LiDAR suites."""
