"""Runtimes of a federation: this process, several, or Flower's simulation on Ray; and metering of its messages."""
