"""Buffered asynchronous rounds on the radio network: vehicles train at their speed, and nobody waits for them."""
