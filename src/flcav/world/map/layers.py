"""Records of a lane-level map: lanes, markings, crossings and lane arrows as vectors, and the outlines of their paint.

Lines and outlines are two-dimensional, in the world frame [m]; angles are in radians. The road surface is at z = 0.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient
from shapely.ops import substring

from flcav.arrays import Array
from flcav.geometry import heading_vectors
from flcav.world.map.roads import LaneKind

MarkingKind = Literal["solid", "dashed", "stop_line", "yield_line", "edge"]
ArrowKind = Literal["straight", "left", "right", "straight_left", "straight_right", "left_right", "straight_left_right"]


@dataclass(frozen=True)
class MapLane:
    """A lane, on a street or inside a junction."""

    id: str
    kind: LaneKind
    centre_line: Array  # (K, 2) in driving direction; outline of a walkingarea [m]
    width_m: float  # [m]
    speed: float  # limit [m/s]
    junction: str  # the junction that contains it; empty on a street
    turn: str  # of a lane inside a junction: s straight, l left, r right, t U-turn; else empty
    light: str  # of a lane inside a junction: "junction:link" of the signal that controls its entry; else empty
    successors: tuple[str, ...]  # ids of the lanes that it leads to


@dataclass(frozen=True)
class Marking:
    """A road marking: one painted line."""

    kind: MarkingKind
    line: Array  # (K, 2) centre line of the paint [m]
    width_m: float  # [m]
    dash_m: float  # length of a dash [m]; 0 for a continuous line
    gap_m: float  # length between two dashes [m]
    colour: str = "white"


@dataclass(frozen=True)
class Crossing:
    """A pedestrian crossing."""

    id: str
    outline: Array  # (K, 2) counter-clockwise, clipped to the road [m]
    centre_line: Array  # (K, 2) from kerb to kerb [m]
    width_m: float  # [m]


@dataclass(frozen=True)
class Arrow:
    """A lane arrow on the road."""

    kind: ArrowKind
    x: float  # of its centre [m]
    y: float  # of its centre [m]
    yaw: float  # driving direction in which it is read [rad]
    lane: str  # id of its lane


@dataclass(frozen=True)
class MapLayers:
    """The lane-level map of a town, as vector layers."""

    roads: tuple[Array, ...]  # disjoint polygons (K, 2) of drivable surface, counter-clockwise, without holes [m]
    sidewalks: tuple[Array, ...]  # disjoint polygons (K, 2) [m]
    lanes: tuple[MapLane, ...]
    markings: tuple[Marking, ...]
    crossings: tuple[Crossing, ...]
    arrows: tuple[Arrow, ...]


STRIPE_M = 0.5  # width of a zebra crossing's stripes, and of the gaps between them
ARROW_M = 5.0  # length of an arrow
SHAFT_M = 0.15  # width of its shaft


class Paint(NamedTuple):
    """A polygon of road paint."""

    layer: str  # marking | crossing | arrow
    outline: Array  # (K, 2) counter-clockwise, without holes [m]
    colour: str


def outline_paint(layers: MapLayers) -> tuple[Paint, ...]:
    """Return the road paint of a map as polygons, world frame [m]: markings, then crossings, then arrows."""
    return (
        *(Paint("marking", piece, marking.colour) for marking in layers.markings for piece in outline_dashes(marking)),
        *(Paint("crossing", piece, "white") for crossing in layers.crossings for piece in outline_stripes(crossing)),
        *(Paint("arrow", piece, "white") for arrow in layers.arrows for piece in [outline_arrow(arrow)]),
    )


def outline_dashes(marking: Marking) -> Iterator[Array]:
    """Yield the polygons (K, 2) [m] of a marking: one per dash, or one for a continuous line."""
    line = LineString(marking.line)
    period = marking.dash_m + marking.gap_m if marking.dash_m else line.length
    starts = np.arange(0.0, line.length - 1e-6, period)
    for start in starts:
        piece = substring(line, start, min(start + (marking.dash_m or line.length), line.length))
        yield from list_outlines(piece.buffer(marking.width_m / 2, cap_style="flat", join_style="mitre"))


def outline_stripes(crossing: Crossing) -> Iterator[Array]:
    """Yield the polygons (K, 2) [m] of a zebra crossing's stripes, which are along the driving direction."""
    line, outline = LineString(crossing.centre_line), Polygon(crossing.outline)
    count = max(int((line.length + STRIPE_M) / (2 * STRIPE_M)), 1)
    first = (line.length - (2 * count - 1) * STRIPE_M) / 2
    for start in first + 2 * STRIPE_M * np.arange(count):
        piece = substring(line, start, start + STRIPE_M)
        if isinstance(piece, LineString):
            yield from list_outlines(piece.buffer(crossing.width_m / 2, cap_style="flat").intersection(outline))


def outline_arrow(arrow: Arrow) -> Array:
    """Return the outline (K, 2) of a lane arrow, world frame [m]."""
    cos, sin = heading_vectors(arrow.yaw)
    return _glyph(arrow.kind) @ np.array([[cos, sin], [-sin, cos]]) + (arrow.x, arrow.y)


@lru_cache(maxsize=16)
def _glyph(kind: ArrowKind) -> Array:
    """Return the outline (K, 2) of an arrow centred on the origin, pointing along +x [m]."""
    back = -ARROW_M / 2
    heads = kind.split("_")
    shaft = LineString([(back, 0.0), (0.9 if "straight" in heads else -0.2, 0.0)])
    pieces: list[BaseGeometry] = [shaft.buffer(SHAFT_M / 2, cap_style="flat")]
    if "straight" in heads:
        pieces.append(Polygon([(0.6, -0.35), (ARROW_M / 2, 0.0), (0.6, 0.35)]))
    for side, name in ((1.0, "left"), (-1.0, "right")):
        if name in heads:
            bow = LineString([(back / 2, 0.0), (-0.5, side * 0.05), (0.0, side * 0.25), (0.3, side * 0.55)])
            pieces.append(bow.buffer(SHAFT_M / 2, cap_style="flat"))
            pieces.append(Polygon([(-0.35, side * 0.62), (0.85, side * 0.42), (0.75, side * 1.25)]))
    return next(iter(list_outlines(shapely.union_all(pieces).buffer(0.001))))


def list_outlines(shape: BaseGeometry | Iterable[BaseGeometry]) -> Iterator[Array]:
    """Yield the outer rings of a shape's polygons: (K, 2) vertices [m], counter-clockwise, the first not repeated."""
    parts = shape if not isinstance(shape, BaseGeometry) else getattr(shape, "geoms", [shape])
    for part in parts:
        if isinstance(part, Polygon) and part.area > 1e-4:
            yield np.asarray(orient(part).exterior.coords)[:-1]
