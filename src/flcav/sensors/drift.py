"""Errors that wander: the value at a time depends on the time and the stream alone, in whatever order times are asked.

Each is simulated on a grid of STEP_S from time 0 and read off it by linear interpolation.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP_S = 0.1


def wander(rng: np.random.Generator, time_s: float, deviation: Array, correlation_s: float) -> Array:
    """Return (K,) a first-order Gauss-Markov process at `time_s` >= 0.

    It has the standard deviations `deviation` (K,) at all times and forgets over `correlation_s`.
    """
    from scipy.signal import lfilter  # takes a second to import, which who records neither GNSS nor IMU is spared

    kept = np.exp(-STEP_S / correlation_s)
    normal = _grid(rng, time_s, len(deviation))
    normal[1:] *= np.sqrt(1 - kept**2)
    return deviation * _read(np.asarray(lfilter([1.0], [1.0, -kept], normal, axis=0)), time_s)


def walk(rng: np.random.Generator, time_s: float, start: Array, per_root_s: Array) -> Array:
    """Return (K,) a random walk at `time_s` >= 0.

    It begins with the standard deviations `start` (K,); its increments over t seconds have `per_root_s` * sqrt(t).
    """
    normal = _grid(rng, time_s, len(start))
    normal[0] *= start
    normal[1:] *= per_root_s * np.sqrt(STEP_S)
    return _read(np.cumsum(normal, axis=0), time_s)


def _grid(rng: np.random.Generator, time_s: float, axes: int) -> Array:
    return rng.standard_normal((int(time_s / STEP_S) + 2, axes))


def _read(values: Array, time_s: float) -> Array:
    step, share = divmod(time_s / STEP_S, 1.0)
    return (1 - share) * values[int(step)] + share * values[int(step) + 1]
