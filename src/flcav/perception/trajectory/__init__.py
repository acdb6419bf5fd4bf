"""Trajectory prediction of vehicles: an LSTM over past tracks and a bird's-eye view, of map rasters or of cameras."""
