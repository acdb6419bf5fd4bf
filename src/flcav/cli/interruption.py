"""Ctrl-C: what becomes of the work is said by the command that knows."""

import contextlib
from collections.abc import Callable, Iterator

GOES_ON = "the same command goes on where it stopped"


class Interrupted(Exception):
    """Raised for Ctrl-C; the message says what is kept."""


@contextlib.contextmanager
def when_interrupted(kept: Callable[[], str] = lambda: GOES_ON) -> Iterator[None]:
    """Turn Ctrl-C within into `Interrupted`, with what `kept` says then. Typer itself would leave a bare exit code."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted(kept()) from None
