"""A deployed fleet: authority, registry, the proxy in front of Flower's SuperLink, vehicles, releases, and status."""
