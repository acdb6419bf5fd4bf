"""A limit on the time of a block, so that a hang is a failure of one case and not of all tests."""

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType


class Slow(BaseException):
    """The time for one case is over; no Exception, so that nothing but the test takes it for its own."""


@contextlib.contextmanager
def within(limit_s: float) -> Iterator[None]:
    """Raise `Slow` in the block after so many seconds of computing, or ten times as many of waiting."""

    def over(number: int, frame: FrameType | None) -> None:
        raise Slow

    clocks = ((signal.ITIMER_PROF, signal.SIGPROF, limit_s), (signal.ITIMER_REAL, signal.SIGALRM, 10 * limit_s))
    before = [signal.signal(number, over) for _, number, _ in clocks]
    for clock, _, seconds in clocks:
        signal.setitimer(clock, seconds)
    try:
        yield
    finally:
        for (clock, number, _), handler in zip(clocks, before, strict=True):
            signal.setitimer(clock, 0)
            signal.signal(number, handler)
