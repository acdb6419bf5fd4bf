"""Modes of a round: how the server gets the updates of those who take part."""
