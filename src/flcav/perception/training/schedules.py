"""How the learning rate goes over a training."""

import math
from collections.abc import Callable


def constant(done: float) -> float:
    """Return 1: the learning rate stays."""
    return 1.0


def one_cycle(done: float) -> float:
    """Return the share of the peak learning rate when a share `done` in [0, 1] of the steps is over.

    From 1/25 up to 1 over the first 30 %, then down to 1/10000, both along a cosine (Smith and Topin, 2018).
    """
    warm, low, floor = 0.3, 1 / 25, 1e-4
    if done < warm:
        return 1 - (1 - low) * (1 + math.cos(math.pi * done / warm)) / 2
    return floor + (1 - floor) * (1 + math.cos(math.pi * (done - warm) / (1 - warm))) / 2


SCHEDULES: dict[str, Callable[[float], float]] = {"constant": constant, "one_cycle": one_cycle}
