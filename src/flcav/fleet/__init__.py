"""A deployed fleet: its authority and registry, the proxy before Flower's SuperLink, vehicles, releases, its status."""
