"""Actors on a relief: their heights, pitch and roll, and how fast they climb.

SUMO moves them in plan. Their horizontal velocity stays as it is; the vertical one follows from the ground they pass.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.world.map.relief import find_tilts

Array = NDArray[np.float64]

STEP_S = 0.3  # of the central differences along an actor's way: longer than it takes over a triangle's edge


class OnRelief(NamedTuple):
    """The motion of A actors at T instants on a relief; NaN where absent."""

    height: Array  # (T, A) of the ground under them [m]
    tilt: Array  # (T, A, 2) pitch and roll [rad]
    velocity: Array  # (T, A, 3) [m/s]
    acceleration: Array  # (T, A, 3) [m/s^2]


def stand_on_relief(
    heights: Callable[[Array, Array], Array],
    centre: Array,
    yaw: Array,
    velocity: Array,
    acceleration: Array,
    size: Array,
    upright: NDArray[np.bool_],
) -> OnRelief:
    """Return the motion of actors on a relief, given that in plan.

    `heights` are those of what each actor stands on, at x, y (T, A) [m]. `centre` (T, A, 2) [m], `yaw` (T, A) [rad],
    `velocity` and `acceleration` (T, A, 3); `size` (A, 3) [m]. Those who are `upright` (A,) do not tilt.
    """

    def height_at(time_s: float) -> Array:
        moved = centre + time_s * velocity[..., :2] + time_s**2 / 2 * acceleration[..., :2]
        x, y = moved[..., 0], moved[..., 1]
        return np.where(upright, heights(x, y), find_tilts(heights, x, y, yaw, size)[0])

    _, pitch, roll = find_tilts(heights, centre[..., 0], centre[..., 1], yaw, size)
    tilt = np.where(upright[:, None], 0.0, np.stack((pitch, roll), axis=2))
    tilt[np.isnan(yaw)] = np.nan
    before, now, after = (height_at(time_s) for time_s in (-STEP_S, 0.0, STEP_S))
    climb = (after - before) / (2 * STEP_S)
    change = (after - 2 * now + before) / STEP_S**2
    return OnRelief(
        now,
        tilt,
        np.concatenate((velocity[..., :2], climb[..., None]), axis=2),
        np.concatenate((acceleration[..., :2], change[..., None]), axis=2),
    )
