"""Commands about plans: fit learning curves, allocate budgets, place sensors."""
