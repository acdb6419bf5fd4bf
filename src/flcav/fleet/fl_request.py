"""FL request: the message by which a vehicle whose network errs requests federated learning from its edge server.

It goes to the proxy of a fleet with the vehicle's certificate, which says whose it is, and is taken once: its nonce
stays in the registry for longer than a request may be old, so that a request sent again is refused, also by a proxy
that was started anew. Wang et al., IEEE Network 37(3), 2023.
"""

import json
import os
import re
import time
from dataclasses import asdict, dataclass

from flcav.config import InputError

PATH = "/v1/flcav/request"  # at the proxy
LARGEST = 2048  # bytes of a request
OLDEST_S = 300.0  # that a request may be old, or ahead, when it arrives; its nonce is kept for longer
NONCE, TASK = re.compile("[0-9a-f]{32}"), re.compile("[A-Za-z0-9_.:-]{1,64}")


@dataclass(frozen=True)
class FLRequest:
    """Request of a vehicle for federated learning of a task, with its loss."""

    nonce: str  # drawn by the vehicle, 32 hexadecimal digits
    time: float  # when it was made [s since 1970]
    task: str
    loss: float  # of the network that drives, on frames held back from training
    frames: int  # whose number this is
    x: float  # of the vehicle, in the town's frame [m]
    y: float

    def as_bytes(self) -> bytes:
        """Return it as it is sent: JSON."""
        return json.dumps(asdict(self), allow_nan=False).encode()


def make_request(task: str, loss: float, frames: int, at: tuple[float, float]) -> FLRequest:
    """Return a new request; raises `InputError` where a part of it cannot be sent."""
    made = FLRequest(os.urandom(16).hex(), time.time(), task, loss, frames, *at)
    if (wrong := _find_wrong(made)) is not None:
        raise InputError(f"request: {wrong}")
    return made


def parse_request(data: bytes) -> FLRequest:
    """Return the request in a message; raises ValueError for another message, in words."""
    if len(data) > LARGEST:
        raise ValueError(f"a request has {LARGEST} bytes at most")
    try:
        found = FLRequest(**json.loads(data))
    except (ValueError, TypeError, RecursionError):
        raise ValueError("the message is no FL request") from None
    if (wrong := _find_wrong(found)) is not None:
        raise ValueError(wrong)
    return found


def _find_wrong(own: FLRequest) -> str | None:
    """Return in words what is wrong with a request, if anything is."""
    if not isinstance(own.nonce, str) or not NONCE.fullmatch(own.nonce):
        return "a nonce of 32 hexadecimal digits is wanted"
    if not isinstance(own.task, str) or not TASK.fullmatch(own.task):
        return "the name of a task is wanted"
    numbers = own.time, own.loss, own.x, own.y
    if any(isinstance(each, bool) or not isinstance(each, int | float) or not abs(each) < 1e12 for each in numbers):
        return "time, loss and position are finite numbers"
    if isinstance(own.frames, bool) or not isinstance(own.frames, int) or not 0 < own.frames < 10**9:
        return "a number of frames, 1 or more, is wanted"
    return None


def check_age(request: FLRequest, now: float) -> str | None:
    """Return in words why a request is too old, or from the future; None: it is neither."""
    late = now - request.time
    return None if abs(late) <= OLDEST_S else f"the request is {abs(late):.0f} s {'old' if late > 0 else 'ahead'}"
