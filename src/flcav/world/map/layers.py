"""Records of a lane-level map: lanes, road markings, crossings and lane arrows as vectors.

Lines and outlines are two-dimensional, in the world frame [m]; angles are in radians. The road surface is at z = 0.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flcav.world.map.roads import LaneKind

Array = NDArray[np.float64]

MarkingKind = Literal["solid", "dashed", "stop_line", "yield_line", "edge"]
ArrowKind = Literal["straight", "left", "right", "straight_left", "straight_right", "left_right", "straight_left_right"]


@dataclass(frozen=True)
class MapLane:
    """One lane, on a street or inside a junction."""

    id: str
    kind: LaneKind
    centre_line: Array  # (K, 2) in driving direction; the outline of a walkingarea
    width_m: float
    speed: float  # limit [m/s]
    junction: str  # the junction it lies in; empty on a street
    turn: str  # of a lane inside a junction: s straight, l left, r right, t U-turn; else empty
    light: str  # of a lane inside a junction: "junction:link" of the signal that controls its entry; else empty
    successors: tuple[str, ...]  # ids of the lanes that it leads to


@dataclass(frozen=True)
class Marking:
    """A road marking: one painted line."""

    kind: MarkingKind
    line: Array  # (K, 2) centre line of the paint
    width_m: float
    dash_m: float  # length of a dash; 0 for a continuous line
    gap_m: float  # between two dashes
    colour: str = "white"


@dataclass(frozen=True)
class Crossing:
    """A pedestrian crossing."""

    id: str
    outline: Array  # (K, 2) counter-clockwise, clipped to the road
    centre_line: Array  # (K, 2) from kerb to kerb
    width_m: float


@dataclass(frozen=True)
class Arrow:
    """A lane arrow on the road: position of its middle [m] and the driving direction in which it is read [rad]."""

    kind: ArrowKind
    x: float
    y: float
    yaw: float
    lane: str  # id of the lane it lies on


@dataclass(frozen=True)
class MapLayers:
    """The lane-level map of a town, as vector layers."""

    roads: tuple[Array, ...]  # disjoint polygons (K, 2) of drivable surface, counter-clockwise, without holes
    sidewalks: tuple[Array, ...]  # disjoint polygons (K, 2)
    lanes: tuple[MapLane, ...]
    markings: tuple[Marking, ...]
    crossings: tuple[Crossing, ...]
    arrows: tuple[Arrow, ...]
