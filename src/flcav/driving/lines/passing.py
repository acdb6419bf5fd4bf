"""Passing of standing vehicles: candidate lines parallel to the route, within the lanes of the town.

A line begins at the vehicle's present place and blends smoothly into a fixed lateral offset from the route. The driver
takes the offset with the highest acceleration (`driver`). Where every line touches the margin of a standing vehicle,
but not the vehicle itself, it creeps past.
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

ASIDE_M = (0.3, 0.6, 0.9, 1.2, 1.5, -0.3, -0.6)  # lateral offsets to the left of the route, in the order of trial
OVER_M = 6.0  # least length of the transition to the offset
OVER_S = 1.2  # its duration at the present speed
LOOKED_M = np.arange(0.0, 30.0, 1.5)  # distances ahead at which the line has to be within the lanes
SLIM_M = 0.15  # margin around standing vehicles when creeping past
CREEPS_MPS = 2.5
STANDS_MPS = 0.5  # below it a road user stands


class ReferenceLine(Protocol):
    """A curve parametrised by the distance along a route: the route itself, or a line parallel to it."""

    def at(self, along: ArrayLike) -> Array:
        """Return x, y [m] and heading [rad] (..., 3) at these distances [m]."""
        ...


@dataclass(frozen=True)
class Beside:
    """A line parallel to a route, with a smooth transition from the vehicle's present place to a lateral offset."""

    route: Route
    begins_m: float  # where the transition begins, along the route
    from_m: float  # lateral offset there, to the left
    to_m: float  # lateral offset after the transition, to the left
    over_m: float  # length of the transition

    def at(self, along: ArrayLike) -> Array:
        """Return x, y [m] and heading [rad] (..., 3) at these distances along the route [m]."""
        along = np.asarray(along, np.float64)
        # Cubic smoothstep: no lateral slope at either end, so that the heading is continuous.
        share = np.clip((along - self.begins_m) / self.over_m, 0.0, 1.0)
        aside = self.from_m + (self.to_m - self.from_m) * share**2 * (3 - 2 * share)
        slope = (self.to_m - self.from_m) * 6 * share * (1 - share) / self.over_m
        return move_aside(self.route.at(along), aside, slope)


def move_aside(pose: Array, aside: Array, slope: Array) -> Array:
    """Return poses x, y [m], heading [rad] (..., 3) moved `aside` (...) [m] to their left, by `slope` (...) a metre."""
    place = pose[..., :2] + aside[..., None] * left_vectors(pose[..., 2])
    return np.concatenate((place, (pose[..., 2] + np.arctan(slope))[..., None]), axis=-1)


def list_lines(
    route: Route, along: float, left_m: float, speed: float, width_m: float, lanes: BaseGeometry
) -> list[Beside]:
    """Return the lines around an obstacle on a route on which a vehicle of width `width_m` [m] stays within the lanes.

    The vehicle is at the distance `along` [m] of the route, `left_m` [m] to its left, and drives at `speed` [m/s].
    """
    over = max(OVER_M, OVER_S * speed)
    lines = [Beside(route, along, left_m, aside, over) for aside in ASIDE_M]
    return [line for line in lines if _is_within(line, along, width_m, lanes)]


def _is_within(line: Beside, along: float, width_m: float, lanes: BaseGeometry) -> bool:
    poses = line.at(along + LOOKED_M)
    edge = np.sign(line.to_m) * width_m / 2 * left_vectors(poses[:, 2])
    return bool(shapely.contains_xy(lanes, *(poses[:, :2] + edge).T).all())


def join_lanes(town: Town) -> BaseGeometry:
    """Return the area of a town's driving lanes (world frame, [m]), prepared for many queries."""
    net = read_net(town.net)
    lanes = [lane for edge in net.edges.values() for lane in edge.lanes_of("driving")]
    area = shapely.union_all([shapely.LineString(lane.shape).buffer(lane.width / 2 + 0.05) for lane in lanes])
    shapely.prepare(area)
    return area


def find_standing(velocity: Array, label: NDArray[np.str_]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the road users that are standing vehicles; `velocity` is (N, 2) [m/s]."""
    afoot = np.char.lower(label) == "pedestrian"
    return (np.hypot(*velocity.T) < STANDS_MPS) & ~afoot
