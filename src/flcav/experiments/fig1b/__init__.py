"""Fig. 1b of the article: the four perception tasks on one scene."""
