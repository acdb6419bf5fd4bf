"""Where road users will be: an LSTM over tracks and a bird's-eye view of the surroundings (rasters, or cameras)."""
