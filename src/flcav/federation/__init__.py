"""The three training stages over a vehicle-edge-cloud network."""
