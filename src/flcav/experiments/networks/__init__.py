"""Search of a network that is worth its training time."""
