"""The motion of a box as a Kalman filter: constant velocity on the ground, everything else stays.

The state is x, y, z, length, width, height, yaw, then the velocity along x and y: that of Weng et al., "3D Multi-Object
Tracking: A Baseline and New Evaluation Metrics", IROS 2020, sec. III-B, without a vertical velocity. Its process noise
is that of white acceleration, so that frames may be any time apart (Bar-Shalom et al., "Estimation with Applications to
Tracking and Navigation", 2001, eq. 6.3.2-4).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import wrap_angle

Array = NDArray[np.float64]

MEASURED, STATES = 7, 9
YAW = 6
ACCELERATION = 3.0  # standard deviation [m/s^2]
DRIFT = np.array((0, 0, 0.2, 0.05, 0.05, 0.05, 0.3))  # of z, size and yaw [per root second]
FIRST_SPEED = 8.0  # standard deviation of a velocity of which nothing is known [m/s]
LEAST_VARIANCE = np.array((0.1, 0.1, 0.1, 0.2, 0.1, 0.1, 0.15)) ** 2  # of a detection's x, y, z, size, yaw


class State(NamedTuple):
    """What is known of one object."""

    mean: Array  # (9,)
    covariance: Array  # (9, 9)


def first_state(box: Array, variance: Array) -> State:
    """Return the state of an object seen once, as box (7,) with `variance` (7,); nothing is known of its velocity."""
    spread = np.concatenate((np.maximum(variance, LEAST_VARIANCE), np.full(2, FIRST_SPEED**2)))
    return State(np.concatenate((box, np.zeros(2))), np.diag(spread))


def predicted(state: State, after_s: float) -> State:
    """Return the state `after_s` later."""
    step = np.eye(STATES)
    step[0, 7] = step[1, 8] = after_s
    noise = np.zeros((STATES, STATES))
    noise[range(MEASURED), range(MEASURED)] = DRIFT**2 * after_s
    for place, speed in ((0, 7), (1, 8)):
        noise[place, place] += after_s**4 / 4
        noise[speed, speed] += after_s**2
        noise[place, speed] = noise[speed, place] = after_s**3 / 2
    both = np.ix_((0, 1, 7, 8), (0, 1, 7, 8))
    noise[both] *= ACCELERATION**2
    return State(step @ state.mean, step @ state.covariance @ step.T + noise)


def innovation(state: State, box: Array, variance: Array) -> tuple[Array, Array]:
    """Return how far box (7,) is from what `state` expects (7,), and the covariance of that (7, 7).

    A heading that is opposite to the expected one is taken for a mistake of the detector and turned.
    """
    off = box - state.mean[:MEASURED]
    turn = float(wrap_angle(off[YAW]))
    off[YAW] = turn if abs(turn) <= np.pi / 2 else float(wrap_angle(turn + np.pi))
    return off, state.covariance[:MEASURED, :MEASURED] + np.diag(np.maximum(variance, LEAST_VARIANCE))


def updated(state: State, box: Array, variance: Array) -> State:
    """Return the state after it was seen as box (7,) with `variance` (7,)."""
    off, spread = innovation(state, box, variance)
    gain = np.linalg.solve(spread, state.covariance[:MEASURED]).T
    mean = state.mean + gain @ off
    mean[YAW] = wrap_angle(mean[YAW])
    rest = np.eye(STATES)
    rest[:, :MEASURED] -= gain
    noise = np.diag(np.maximum(variance, LEAST_VARIANCE))
    return State(mean, rest @ state.covariance @ rest.T + gain @ noise @ gain.T)  # Joseph's form: stays symmetric
