"""Fig. 6a of the article: joint allocation against equal stages."""
