"""Fig. 6a of the article: joint allocation (MLGRA) against equal shares for every stage, by training."""
