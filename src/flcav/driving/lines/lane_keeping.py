"""Lane keeping by the camera: the centre of the vehicle's lane, between the lane lines that the road network finds.

Lines on the ground are cut by the normals of the route at `STATIONS_M` ahead. The centre of the lane is midway between
the nearest line on either side; where there is one alone, half of the lane's width from it, by the map. A straight line
in the route's coordinates is fitted to the centres. The map says which lane, and where it leads: centres farther than
`FARTHEST_M` from the route are left out, and a lane that leaves it, or is seen too little, is not followed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import ArrayLike

from flcav.arrays import Array
from flcav.driving.lines.passing import move_aside
from flcav.geometry import left_vectors
from flcav.world.map.roads import Route

STATIONS_M: Array = np.arange(5.0, 31.0)  # (S,) distances from the vehicle's centre along its route
FITTED_M = 16.0  # up to which centres are fitted
LEAST = 5  # number of them that a lane needs
FARTHEST_M = 1.0  # largest distance of such a centre from the route
STEEPEST = 0.1  # largest slope of a lane to the route
BESIDE_M = 1.0  # beyond the lane's border by the map, up to which a line is looked for
WIDTH_M = 0.8  # greatest difference of the distance of two lines from the lane's width by the map
LASTS_S = 1.0  # for which a lane is followed after its picture


@dataclass(frozen=True)
class SeenLane:
    """The centre of a lane as it was seen: a line parallel to a route, or at a small angle to it."""

    route: Route
    from_m: float  # where the vehicle was, along the route
    to_m: float  # farthest place along the route at which the lane was seen
    aside_m: float  # of the centre at `from_m`, to the left of the route
    slope: float  # by which that grows along the route

    def at(self, along: ArrayLike) -> Array:
        """Return x, y [m] and heading [rad] (..., 3) at these distances along the route [m]."""
        along = np.asarray(along, np.float64)
        aside = self.aside_m + self.slope * (along - self.from_m)
        return move_aside(self.route.at(along), aside, np.full_like(along, self.slope))


def find_centres(lines: Sequence[Array], route: Route, along: float) -> Array:
    """Return the centre (S,) of the lane between lines (K, 2) at `STATIONS_M` ahead of a place on a route, world frame.

    Centres are distances to the left of the route [m]; NaN where no line is.
    """
    at = along + STATIONS_M
    pose, width = route.at(at), route.lane_width(at)
    left, right = (_reach(lines, pose, side * (width / 2 + BESIDE_M)) for side in (1, -1))
    with np.errstate(invalid="ignore"):
        both = np.abs(left + right - width) <= WIDTH_M
    nearer = np.where(np.nan_to_num(left, nan=np.inf) <= np.nan_to_num(right, nan=np.inf), left, width - right)
    return np.where(both, (left - right) / 2, nearer - width / 2)


def _reach(lines: Sequence[Array], pose: Array, aside: Array) -> Array:
    """Return how far (S,) lines are from poses (S, 3) at most `aside` (S,) to their left; NaN where none is."""
    starts = pose[:, :2]
    probes = shapely.linestrings(np.stack((starts, starts + aside[:, None] * left_vectors(pose[:, 2])), axis=1))
    met = shapely.intersection(shapely.MultiLineString(list(lines)), probes)
    return np.asarray(shapely.distance(shapely.points(starts), met))


def fit_lane(centres: Array, route: Route, along: float) -> SeenLane | None:
    """Return the lane through centres (S,) as of `find_centres`; None where they are too few, or leave the route."""
    used = (np.abs(np.nan_to_num(centres, nan=np.inf)) <= FARTHEST_M) & (STATIONS_M <= FITTED_M)
    if used.sum() < LEAST:
        return None
    slope, aside = np.polyfit(STATIONS_M[used], centres[used], 1).tolist()
    last = float(STATIONS_M[used][-1])
    if abs(slope) > STEEPEST:
        return None
    return SeenLane(route, along, along + last, aside, slope)
