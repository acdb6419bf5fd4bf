"""Modes of a round: how the server collects the updates of its clients."""
