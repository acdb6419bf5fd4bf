"""A deployed fleet: its authority and registry, mutual TLS in front of Flower's SuperLink, and its processes."""
