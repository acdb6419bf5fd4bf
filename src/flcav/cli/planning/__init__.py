"""Commands about plans: fit learning curves, allocate resources, place sensors."""
