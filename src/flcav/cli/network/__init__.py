"""Commands about the network between vehicles, edge servers and the cloud."""
