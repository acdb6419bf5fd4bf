"""Perceived surroundings of the vehicle: road users with predicted paths, lights, and the factor of the weather.

All tasks of perception end here: `objects` in the boxes, `trajectory` in the paths, `signs` in the lights, `weather` in
the speed. World frame: ENU, metres, radians, seconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, heading_vectors, wrap_angle
from flcav.world.snapshot import Snapshot

Array = NDArray[np.float64]

TIMES_S: Array = np.arange(0.0, 4.01, 0.25)  # of the points of predicted paths, from the present on
EGO = "ego"
WEATHER_SPEED: Mapping[str, float] = {  # share of the speed limit that a driver keeps to in each class of weather
    "clear": 1.0,
    "cloudy": 1.0,
    "overcast": 1.0,
    "sunset": 1.0,
    "night": 0.9,
    "light_rain": 0.9,
    "heavy_rain": 0.75,
    "fog": 0.6,
}


@dataclass(frozen=True)
class Seen:
    """The surroundings of the ego vehicle at one instant, as its perception has them."""

    boxes: Boxes  # (N,) road users
    velocity: Array  # (N, 2) over ground [m/s]
    path: Array  # (N, T, 2) predicted positions at `TIMES_S` [m]
    yaw: Array  # (N, T) predicted headings [rad]
    spread: Array  # (N, T) standard deviation of the predicted position, along each axis [m]
    closed: frozenset[str]  # entries of `Trace.light` that are seen not to be green
    amber: frozenset[str]  # those of them that are yellow
    speed_share: float = 1.0  # of the speed limit, for the weather


class Perception(Protocol):
    """The interface of a driver's perception: from the world to its perceived surroundings."""

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the perceived surroundings at this instant; called once for every decision, in order of time."""
        ...


def predict_motion(boxes: Boxes, velocity: Array, yaw_rate: Array | None = None) -> tuple[Array, Array]:
    """Return paths (N, T, 2) [m] and headings (N, T) [rad] at `TIMES_S`: constant velocity, and turn rate if given.

    The chord of the arc is used (Schubert et al., FUSION 2008, CTRV); `yaw_rate` is (N,) [rad/s].
    """
    turn = np.zeros((len(boxes), 1)) if yaw_rate is None else yaw_rate[:, None] * TIMES_S
    half = turn / 2
    speed, course = np.linalg.norm(velocity, axis=1), np.arctan2(velocity[:, 1], velocity[:, 0])
    chord = speed[:, None] * TIMES_S * np.sinc(half / np.pi)
    path = boxes.center[:, None, :2] + chord[..., None] * heading_vectors(course[:, None] + half)
    return path, np.asarray(wrap_angle(boxes.yaw[:, None] + np.broadcast_to(turn, chord.shape)))
