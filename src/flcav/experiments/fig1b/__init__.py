"""Fig. 1b of the article: four tasks on one scene."""
