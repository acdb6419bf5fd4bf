"""Tasks, their networks, metrics and errors."""
