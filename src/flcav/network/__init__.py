"""What moves over which link, and what it costs."""
