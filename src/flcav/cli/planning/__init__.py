"""Commands for planning: learning histories and curves, allocation of budgets, placement of sensors."""
