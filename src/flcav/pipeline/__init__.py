"""The system: a run recipe in, typed results out, through the three stages of training."""
