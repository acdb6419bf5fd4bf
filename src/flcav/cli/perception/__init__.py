"""Commands about perception tasks: train, evaluate, infer, register errors."""
