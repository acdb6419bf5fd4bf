"""Fig. 3a of the article: learning curves and the plans that follow from them."""
