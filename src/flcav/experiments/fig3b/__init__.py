"""Fig. 3b: errors of a detector in a town, and the sensors placed for them."""
