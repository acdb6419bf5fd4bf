"""Free ports of this machine for servers under test."""

import contextlib
import random
import socket

PORTS = range(10_000, 32_768)  # below those that Linux lends to clients, which would take one before its server is up


def find_port(count: int = 1) -> int:
    """Return the first of so many free ports that follow each other."""
    while True:
        first = random.choice(PORTS[:-count])
        with contextlib.suppress(OSError), contextlib.ExitStack() as doors:
            for port in range(first, first + count):
                doors.enter_context(socket.socket()).bind(("127.0.0.1", port))
            return first
