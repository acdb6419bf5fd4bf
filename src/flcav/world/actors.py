"""Actors of a live world at one instant."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Actors(NamedTuple):
    """N actors at one instant, world frame: the fields of a `Trace`."""

    name: tuple[str, ...]  # (N,)
    category: tuple[str, ...]  # (N,)
    shape: NDArray[np.int64]  # (N,)
    size: Array  # (N, 3) length, width, height [m]
    position: Array  # (N, 3) ground centre [m]
    yaw: Array  # (N,) [rad]
    velocity: Array  # (N, 3) [m/s]
    acceleration: Array  # (N, 3) [m/s^2]
    yaw_rate: Array  # (N,) [rad/s]
    tilt: Array  # (N, 2) pitch and roll [rad]

    @property
    def places(self) -> Array:
        """Return x, y [m] and yaw [rad] of each (N, 3)."""
        return np.column_stack((self.position[:, :2], self.yaw))


_ONES, _TWOS, _THREES = np.zeros(0), np.zeros((0, 2)), np.zeros((0, 3))
NOBODY = Actors((), (), np.zeros(0, np.int64), _THREES, _THREES, _ONES, _THREES, _THREES, _ONES, _TWOS)


def pick_actors(actors: Actors, mask: NDArray[np.bool_]) -> Actors:
    """Return the actors for which `mask` (N,) is true."""
    rows = np.flatnonzero(mask).tolist()
    return Actors(
        tuple(actors.name[row] for row in rows),
        tuple(actors.category[row] for row in rows),
        actors.shape[mask],
        actors.size[mask],
        actors.position[mask],
        actors.yaw[mask],
        actors.velocity[mask],
        actors.acceleration[mask],
        actors.yaw_rate[mask],
        actors.tilt[mask],
    )


def join_actors(*parts: Actors) -> Actors:
    """Return the actors of all parts, in order."""
    return Actors(
        tuple(name for part in parts for name in part.name),
        tuple(category for part in parts for category in part.category),
        *(np.concatenate(column) for column in zip(*(part[2:] for part in parts))),
    )
