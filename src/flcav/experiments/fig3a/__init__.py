"""Fig. 3a of the article: the three-layer graph and learning curves."""
