"""Design and verify federated learning for connected autonomous vehicle (CAV) perception."""

__version__ = "0.1.0"
