"""Learning curves: their forms, fits, bands, and the history they are fitted to."""
