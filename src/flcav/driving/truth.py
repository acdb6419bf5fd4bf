"""Ground-truth perception: true positions and velocities of all road users; paths of constant speed and turn rate.

What they are going to do is not known to anybody in a live world, so that paths are predicted here, too.
"""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from flcav.driving.seen import EGO, TIMES_S, WEATHER_SPEED, Seen, predict_motion
from flcav.geometry import Boxes
from flcav.world.snapshot import Snapshot

AMBER, CLOSED = "y", "ryu"  # SUMO's letters
SIGHT_M = 90.0


class Truth:
    """Ground truth within `SIGHT_M` of the ego vehicle; one per drive, since parked vehicles are looked up once."""

    def __init__(self, weather: str = "clear") -> None:
        self._share = WEATHER_SPEED[weather]

    def look(self, snapshot: Snapshot) -> Seen:
        """Return all road users, lights, and the speed share of the weather as it is."""
        rows = find_around(snapshot, SIGHT_M)
        boxes, velocity, yaw_rate = read_actors(snapshot, rows)
        path, yaw = predict_motion(boxes, velocity, np.where(boxes.label == "pedestrian", 0.0, yaw_rate))
        closed, amber = read_lights(snapshot)
        return Seen(boxes, velocity, path, yaw, np.zeros((len(rows), len(TIMES_S))), closed, amber, self._share)


def find_around(snapshot: Snapshot, reach_m: float) -> NDArray[np.int64]:
    """Return the rows of the actors within `reach_m` of the ego vehicle, without itself."""
    trace, own = snapshot.trace, snapshot.row(EGO)
    away = np.linalg.norm(trace.position[0, :, :2] - trace.position[0, own, :2], axis=1)
    away[own] = np.inf
    return np.flatnonzero(away <= reach_m)


def read_actors(snapshot: Snapshot, rows: NDArray[np.int64]) -> tuple[Boxes, NDArray[np.float64], NDArray[np.float64]]:
    """Return boxes (labels are categories), velocities (N, 2) [m/s] and yaw rates (N,) [rad/s] of some actors."""
    trace = snapshot.trace
    size = trace.size[rows]
    centre = trace.position[0, rows] + size * np.array((0.0, 0.0, 0.5))
    boxes = Boxes(centre, size, trace.yaw[0, rows], trace.category[rows])
    return boxes, trace.velocity[0, rows, :2], trace.yaw_rate[0, rows]


def read_lights(snapshot: Snapshot) -> tuple[frozenset[str], frozenset[str]]:
    """Return the lights that are not green, and those of them that are yellow."""

    def showing(letters: Collection[str]) -> frozenset[str]:
        return frozenset(snapshot.trace.light[np.isin(snapshot.trace.light_state[0], list(letters))].tolist())

    return showing(CLOSED), showing(AMBER)
