"""The corridor of a route: where and when predicted footprints lie in the way of a vehicle that follows it.

Distances along the route are from the vehicle's middle. A footprint is taken for `PARTS` points along each of its
sides, which are nearer to each other than the corridor is wide for vehicles of up to 12 m.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from flcav.geometry import Boxes, heading_vectors, left_vectors
from flcav.world.map.roads import Route

Array = NDArray[np.float64]

PARTS = 6
SPACING_M = 1.0  # of the points of the route that a place is compared with
BEHIND_M = 6.0  # how far back, and
AHEAD_M = 80.0  # ahead the corridor goes


class Occupied(NamedTuple):
    """The part of the corridor that each of N footprints covers at each of T times; empty where `low` > `high`."""

    low: Array  # (N, T) nearest distance along the route [m], inf where it covers none
    high: Array  # (N, T) farthest, -inf where it covers none


def find_occupied(
    route: Route, along: float, boxes: Boxes, path: Array, yaw: Array, half_width_m: float, margin_m: Array
) -> Occupied:
    """Return what footprints cover of the corridor of a vehicle that is `along` the route [m].

    `boxes` give the sizes of N road users, `path` (N, T, 2) and `yaw` (N, T) their poses; `half_width_m` is that of
    the vehicle, `margin_m` (N, T) what is kept free on all sides of each footprint.
    """
    n, times = yaw.shape
    low, high = np.full((n, times), np.inf), np.full((n, times), -np.inf)
    marks = np.arange(-BEHIND_M, AHEAD_M, SPACING_M)
    points = route.at(along + marks)
    heading, left = heading_vectors(points[:, 2]), left_vectors(points[:, 2])
    reach = np.hypot(*boxes.size[:, :2].T)[:, None] / 2 + half_width_m + margin_m + SPACING_M
    row, instant = _find_near(path, points[:, :2], reach)
    if not len(row):
        return Occupied(low, high)
    shares = np.linspace(-0.5, 0.5, PARTS)
    unit = np.concatenate([np.c_[shares, np.full(PARTS, side)] for side in (-0.5, 0.5)])
    offset = unit[None] * boxes.size[row, None, :2]
    turn = yaw[row, instant]
    corner = path[row, instant][:, None] + offset[..., :1] * heading_vectors(turn)[:, None]
    corner = corner + offset[..., 1:] * left_vectors(turn)[:, None]  # (M, 2 PARTS, 2)
    nearest = cdist(corner.reshape(-1, 2), points[:, :2]).argmin(axis=1).reshape(corner.shape[:2])
    gap = corner - points[nearest, :2]
    ahead = (gap * heading[nearest]).sum(axis=2)
    aside = (gap * left[nearest]).sum(axis=2)
    within = (np.abs(aside) <= half_width_m + margin_m[row, instant][:, None]) & (np.abs(ahead) <= 2 * SPACING_M)
    sides = aside.min(axis=1) * aside.max(axis=1) < 0  # it reaches across the corridor's middle
    within |= (sides & ~within.any(axis=1))[:, None] & (np.abs(ahead) <= 2 * SPACING_M)
    at = marks[nearest] + ahead
    slack = margin_m[row, instant]
    low[row, instant] = np.where(within, at, np.inf).min(axis=1) - slack
    high[row, instant] = np.where(within, at, -np.inf).max(axis=1) + slack
    return Occupied(low, high)


def find_meeting(occupied: Occupied, at: Array, half_length_m: float) -> NDArray[np.bool_]:
    """Return (N, T) whether a vehicle whose middle is `at` (T,) [m] along the corridor then touches each footprint."""
    return (occupied.low <= at + half_length_m) & (occupied.high >= at - half_length_m)


def _find_near(path: Array, points: Array, reach: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and times of the places (N, T, 2) that are within `reach` (N, T) of the route's `points`."""
    low, high = points.min(axis=0), points.max(axis=0)
    about = (path >= low - reach[..., None]) & (path <= high + reach[..., None])
    row, instant = np.nonzero(about.all(axis=2))
    if len(row):
        apart = cdist(path[row, instant], points, "chebyshev").min(axis=1)
        near = apart < reach[row, instant]
        row, instant = row[near], instant[near]
    return row, instant
