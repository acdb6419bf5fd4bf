"""Network operations in plain PyTorch."""
