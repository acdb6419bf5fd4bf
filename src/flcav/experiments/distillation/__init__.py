"""Comparison of what vehicles learn from in stage II: the road average, pseudo-labels, ideal labels, no road sensor."""
