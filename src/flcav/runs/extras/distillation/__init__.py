"""Federated distillation: a region's vehicles learn from the road average of what poles and vehicles detect."""
