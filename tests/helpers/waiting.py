"""Waits for what other processes do, on a machine of any speed."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from flcav.fleet.traffic import TRAFFIC, ProxyTraffic, read_traffic

Found = TypeVar("Found")
LONGEST_S = 900.0  # that anything takes on a busy machine


def wait_for(
    what: Callable[[], Found | None], every_s: float = 0.02, tell: Callable[[], str] = lambda: "too late"
) -> Found:
    """Return what `what` returns once that is something.

    Args:
        what: is called until then.
        every_s: pause between its calls.
        tell: what to say where it takes longer than `LONGEST_S`.

    Raises:
        AssertionError: it did.
    """
    end = time.monotonic() + LONGEST_S
    while not (found := what()):
        assert time.monotonic() < end, tell()
        time.sleep(every_s)
    return found


def read_all_traffic(fleet: Path) -> ProxyTraffic:
    """Return the counts of a fleet's proxy with all that was counted before the call.

    They are written with a delay, and vehicles that are up go on calling: what is written second from now on has them.
    """
    for _ in range(2):
        before = _written_ns(fleet)
        wait_for(lambda before=before: _written_ns(fleet) > before)
    return read_traffic(fleet)


def _written_ns(fleet: Path) -> int:
    path = fleet / TRAFFIC
    return path.stat().st_mtime_ns if path.exists() else 0
