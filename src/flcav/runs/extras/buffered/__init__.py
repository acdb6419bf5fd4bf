"""Buffered asynchronous rounds on the radio network: vehicles go on at their own pace, and nobody waits for them."""
