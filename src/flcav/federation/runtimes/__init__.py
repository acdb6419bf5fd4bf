"""Where clients train: in this process, in several, in Flower's simulation on Ray; and metering of their messages."""
