"""FL request: the message by which a vehicle whose network errs requests federated learning from its edge server.

It is sent to the proxy of a fleet, where the TLS certificate identifies the vehicle, and accepted once: its nonce stays
in the registry for longer than a request is valid, so that a replay is refused even after a restart of the proxy. Wang
et al., IEEE Network 37(3), 2023.
"""

import json
import os
import re
import time
from dataclasses import asdict, dataclass

from flcav.config import InputError

PATH = "/v1/flcav/request"  # at the proxy
LARGEST = 2048  # bytes of a request
OLDEST_S = 300.0  # largest age or lead of a request at its arrival [s]; nonces are kept for longer
NONCE, TASK = re.compile("[0-9a-f]{32}"), re.compile("[A-Za-z0-9_.:-]{1,64}")


@dataclass(frozen=True)
class FLRequest:
    """A vehicle's request for federated learning of a task, with its loss."""

    nonce: str  # drawn by the vehicle, 32 hexadecimal digits
    time: float  # of the request [s since 1970]
    task: str
    loss: float  # of the driving network, on frames held back from training
    frames: int  # number of these frames
    x: float  # of the vehicle, world frame [m]
    y: float  # world frame [m]

    def as_bytes(self) -> bytes:
        """Return the request as JSON, as it is sent."""
        return json.dumps(asdict(self), allow_nan=False).encode()


def make_request(task: str, loss: float, frames: int, at: tuple[float, float]) -> FLRequest:
    """Return a new request of a vehicle at (x, y), world frame [m]; raises `InputError` for an invalid value."""
    made = FLRequest(os.urandom(16).hex(), time.time(), task, loss, frames, *at)
    if (wrong := _find_wrong(made)) is not None:
        raise InputError(f"request: {wrong}")
    return made


def parse_request(data: bytes) -> FLRequest:
    """Return the request in a message; raises ValueError, with a sentence, for an invalid message."""
    if len(data) > LARGEST:
        raise ValueError(f"a request has {LARGEST} bytes at most")
    try:
        found = FLRequest(**json.loads(data))
    except (ValueError, TypeError, RecursionError):
        raise ValueError("the message is no FL request") from None
    if (wrong := _find_wrong(found)) is not None:
        raise ValueError(wrong)
    return found


def _find_wrong(request: FLRequest) -> str | None:
    """Return a sentence on what is wrong with a request, if anything is."""
    if not isinstance(request.nonce, str) or not NONCE.fullmatch(request.nonce):
        return "a nonce of 32 hexadecimal digits is wanted"
    if not isinstance(request.task, str) or not TASK.fullmatch(request.task):
        return "the name of a task is wanted"
    numbers = request.time, request.loss, request.x, request.y
    if any(isinstance(each, bool) or not isinstance(each, int | float) or not abs(each) < 1e12 for each in numbers):
        return "time, loss and position are finite numbers"
    if isinstance(request.frames, bool) or not isinstance(request.frames, int) or not 0 < request.frames < 10**9:
        return "a number of frames, 1 or more, is wanted"
    return None


def check_age(request: FLRequest, now: float) -> str | None:
    """Return a sentence if a request is too old or from the future at `now` [s since 1970], else None."""
    late = now - request.time
    return None if abs(late) <= OLDEST_S else f"the request is {abs(late):.0f} s {'old' if late > 0 else 'ahead'}"
