"""The way around what stands at the roadside: a line beside the route, within the lanes of the town.

The line leaves the vehicle's present place and goes over, smoothly, to a fixed distance beside the route. Of several
such distances the one is taken on which the vehicle gets on best; where each touches the margin of something that
stands, but nothing itself, the vehicle passes slowly.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry.base import BaseGeometry

from flcav.geometry import Array, left_vectors
from flcav.world.map.roads import Route, read_net
from flcav.world.map.town import Town

ASIDE_M = (0.3, 0.6, 0.9, 1.2, 1.5, -0.3, -0.6)  # to the left of the route, which are tried in this order
OVER_M, OVER_S = 6.0, 1.2  # the way on which the line goes over, at least, and in time at the present speed
LOOKED_M = np.arange(0.0, 30.0, 1.5)  # ahead, where the line has to be within the lanes
SLIM_M = 0.15  # free beside who stands, where a vehicle passes slowly
CREEPS_MPS = 2.5
STANDS_MPS = 0.5  # of a road user


class ReferenceLine(Protocol):
    """Something with a place at every distance: a route, or a line beside it."""

    def at(self, along: ArrayLike) -> Array:
        """Return x, y [m] and heading [rad] (..., 3) at these distances [m]."""
        ...


@dataclass(frozen=True)
class Beside:
    """A line beside a route, from the vehicle's present place."""

    route: Route
    begins_m: float  # along the route
    from_m: float  # to the left of the route [m], there
    to_m: float  # to its left, from `over_m` further on
    over_m: float

    def at(self, along: ArrayLike) -> Array:
        """Return x, y [m] and heading [rad] (..., 3) at these distances along the route [m]."""
        along = np.asarray(along, np.float64)
        pose = self.route.at(along)
        share = np.clip((along - self.begins_m) / self.over_m, 0.0, 1.0)
        aside = self.from_m + (self.to_m - self.from_m) * share**2 * (3 - 2 * share)
        slope = (self.to_m - self.from_m) * 6 * share * (1 - share) / self.over_m
        place = pose[..., :2] + aside[..., None] * left_vectors(pose[..., 2])
        return np.concatenate((place, (pose[..., 2] + np.arctan(slope))[..., None]), axis=-1)


def list_lines(
    route: Route, along: float, left_m: float, speed: float, width_m: float, lanes: BaseGeometry
) -> list[Beside]:
    """Return the lines beside a route that a vehicle of a width [m] can take within the lanes.

    It is `along` the route and `left_m` to its left [m], at a `speed` [m/s].
    """
    over = max(OVER_M, OVER_S * speed)
    lines = [Beside(route, along, left_m, aside, over) for aside in ASIDE_M]
    return [line for line in lines if _is_within(line, along, width_m, lanes)]


def _is_within(line: Beside, along: float, width_m: float, lanes: BaseGeometry) -> bool:
    poses = line.at(along + LOOKED_M)
    edge = np.sign(line.to_m) * width_m / 2 * left_vectors(poses[:, 2])
    return bool(shapely.contains_xy(lanes, *(poses[:, :2] + edge).T).all())


def join_lanes(town: Town) -> BaseGeometry:
    """Return the area of a town's driving lanes, prepared for many looks."""
    net = read_net(town.net)
    lanes = [lane for edge in net.edges.values() for lane in edge.lanes_of("driving")]
    area = shapely.union_all([shapely.LineString(each.shape).buffer(each.width / 2 + 0.05) for each in lanes])
    shapely.prepare(area)
    return area


def find_standing(velocity: Array, label: NDArray[np.str_]) -> NDArray[np.bool_]:
    """Return (N,) whether road users are vehicles that stand; `velocity` is (N, 2) [m/s]."""
    afoot = np.char.lower(label) == "pedestrian"
    return (np.hypot(*velocity.T) < STANDS_MPS) & ~afoot
