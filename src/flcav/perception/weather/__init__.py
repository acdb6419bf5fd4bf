"""Weather from a camera picture (LeNet-5)."""
