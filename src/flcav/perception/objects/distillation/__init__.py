"""Federated distillation: vehicles learn from the road average of boxes."""
