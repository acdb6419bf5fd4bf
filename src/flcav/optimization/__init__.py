"""What to move and where to look: learning curves, allocation, placement."""
