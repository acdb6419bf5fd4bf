"""What an agent observes, and with what."""
