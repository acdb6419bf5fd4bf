"""Radio network of a run's vehicles."""
