"""What road sensors see and tell: the trained detector, the road average of labels, and registered suites."""
