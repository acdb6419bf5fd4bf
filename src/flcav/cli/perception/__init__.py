"""Commands about tasks: train, evaluate, infer, register errors."""
