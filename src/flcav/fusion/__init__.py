"""Fusion of vehicle and roadside perception into training labels without ground truth."""
