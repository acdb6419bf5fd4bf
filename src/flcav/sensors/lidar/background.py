"""Background filtering for a stationary LiDAR: the static background by direction, and the returns in front of it.

The background of a direction is the farthest return ever observed there; a nearer return at another time is in the
foreground. An object that is in the same place in all sweeps, such as a permanently parked car, becomes background.
Background filtering of roadside LiDARs: Zhao et al., "Detection and tracking of pedestrians and vehicles using roadside
LiDAR sensors", Transportation Research Part C 100, 2019.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array32, Ints, Mask

STEP_DEG = 0.1  # side of a direction's bin: smaller than the angle between two beams
OFFSET_DEG = 0.037  # offset of the bins' edges, so that beams at round angles do not fall on an edge
COLUMNS = round(360 / STEP_DEG)
MARGIN_M = 0.15  # margin in front of the background: several standard deviations of the range error


@dataclass(frozen=True)
class Background:
    """The range of the background by direction, for the D directions with a return; sensor frame."""

    direction: Ints  # (D,) ascending indices of bins of STEP_DEG in azimuth and elevation
    range_m: Array32  # (D,) farthest return [m]

    def in_front(self, points: Array32) -> Mask:
        """Return (N,) whether points (N, >= 3) [m] are in front of the background, or in a direction without any."""
        direction, range_m = _to_polar(points)
        row = np.searchsorted(self.direction, direction)
        row[row == len(self.direction)] = 0
        known = self.direction[row] == direction if len(self.direction) else np.zeros(len(points), dtype=bool)
        farthest = np.where(known, self.range_m[row] if len(self.range_m) else 0.0, np.inf)
        return range_m < farthest - MARGIN_M


def learn_background(sweeps: Iterable[Array32]) -> Background:
    """Learn the background of a LiDAR from its sweeps (N, >= 3) x, y, z [m], sensor frame, all from the same pose.

    With sweeps of eight scenes or more, hardly any place is occupied in all of them.
    """
    background = Background(np.zeros(0, np.int64), np.zeros(0, np.float32))
    for sweep in sweeps:
        direction, range_m = _to_polar(sweep)
        background = _farthest(np.append(background.direction, direction), np.append(background.range_m, range_m))
    return background


def _farthest(direction: Ints, range_m: Array32) -> Background:
    order = np.argsort(direction, kind="stable")
    bins, first = np.unique(direction[order], return_index=True)
    return Background(bins, np.maximum.reduceat(range_m[order], first) if len(first) else range_m)


def _to_polar(points: Array32) -> tuple[Ints, Array32]:
    """Return the bins (N,) and ranges (N,) [m] of points (N, >= 3) [m], sensor frame."""
    x, y, z = points[:, :3].astype(np.float64).T
    flat = np.hypot(x, y)
    azimuth = np.degrees(np.arctan2(y, x)) % 360 + OFFSET_DEG
    elevation = np.degrees(np.arctan2(z, flat)) + 90 + OFFSET_DEG
    column = np.floor(azimuth / STEP_DEG).astype(np.int64) % COLUMNS
    row = np.floor(elevation / STEP_DEG).astype(np.int64)
    return row * COLUMNS + column, np.hypot(flat, z).astype(np.float32)
