"""Flower grids: message passing in this process, and metering of messages."""
