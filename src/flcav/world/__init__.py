"""Towns, their traffic, and the rays that see them."""
