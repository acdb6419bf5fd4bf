"""The demo and the figures: config in, result out."""
