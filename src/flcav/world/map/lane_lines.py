"""Lane lines of a map: its painted lines along the road, joined end to end, with their kind at every point.

A map has a marking per edge and kind: a line that is dashed, and solid before a junction, is two of them, and a double
line is two lines side by side. Here each is one line. A dashed line runs on through its gaps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import LineString

from flcav.arrays import Array, Mask
from flcav.world.map.layers import Marking

ALONG = ("solid", "dashed", "edge")  # kinds of markings along the road
STEP_M = 0.5  # largest distance of two points of a line
BESIDE_M = 0.3  # distance within which two solid lines are one double line
JOINED_M = 0.3  # distance of two ends that are joined
STRAIGHT = 0.87  # least cosine of the angle between lines that are joined


@dataclass(frozen=True)
class LaneLine:
    """A painted line along the road."""

    points: Array  # (K, 2) world frame [m], at most `STEP_M` apart
    solid: Mask  # (K,) whether it is continuous there, otherwise broken
    width_m: float  # of the paint, over both lines of a double one [m]


def join_lane_lines(markings: Sequence[Marking]) -> tuple[LaneLine, ...]:
    """Return the lane lines of a map's markings, world frame [m]; markings across the road are left out."""
    pieces = [_sample(one) for one in _merge_doubles([one for one in markings if one.kind in ALONG])]
    free = [True] * len(pieces)
    joined = []
    for number in range(len(pieces)):
        if not free[number]:
            continue
        free[number] = False
        line = pieces[number]
        for _ in range(2):  # from its end on, then from its beginning, to which it is turned
            while (other := _next(line, pieces, free)) is not None:
                line = _append(line, other)
            line = _reverse(line)
        joined.append(line)
    return tuple(joined)


def _merge_doubles(markings: list[Marking]) -> list[Marking]:
    """Return the markings with both lines of a double one replaced by the line between them."""
    shapes = [LineString(one.line) for one in markings]
    merged, gone = [], set[int]()
    tree = shapely.STRtree(shapes)
    for number, marking in enumerate(markings):
        if number in gone:
            continue
        near = tree.query(shapes[number], "dwithin", BESIDE_M).tolist() if marking.kind == "solid" else []
        twins = [
            other
            for other in sorted(near)
            if other > number and other not in gone and markings[other].kind == "solid"
            if _is_beside(shapes[number], shapes[other])
        ]
        if not twins:
            merged.append(marking)
            continue
        gone.add(twins[0])
        other = shapes[twins[0]]
        nearest = np.array([other.interpolate(other.project(shapely.Point(at))).coords[0] for at in marking.line])
        apart = float(np.median(np.hypot(*(nearest - marking.line).T)))
        width = apart + marking.width_m
        merged.append(Marking("solid", (marking.line + nearest) / 2, width, 0.0, 0.0, marking.colour))
    return merged


def _is_beside(one: LineString, other: LineString) -> bool:
    """Return whether a line lies beside another over its whole length."""
    inner = shapely.line_interpolate_point(other, [0.1, 0.5, 0.9], normalized=True)
    return bool((shapely.distance(one, inner) < BESIDE_M).all()) and abs(one.length - other.length) < 2.0


def _sample(marking: Marking) -> LaneLine:
    line = LineString(marking.line)
    steps = max(int(np.ceil(line.length / STEP_M)), 1)
    points = shapely.get_coordinates(line.interpolate(np.linspace(0.0, 1.0, steps + 1), normalized=True))
    return LaneLine(points, np.full(len(points), marking.kind != "dashed"), marking.width_m)


def _next(line: LaneLine, pieces: list[LaneLine], free: list[bool]) -> LaneLine | None:
    """Return the free piece that goes straight on from the end of a line, and take it; None where there is none."""
    for number, piece in enumerate(pieces):
        if not free[number]:
            continue
        for turned in (piece, _reverse(piece)):
            if np.hypot(*(turned.points[0] - line.points[-1])) < JOINED_M and _goes_on(line, turned):
                free[number] = False
                return turned
    return None


def _goes_on(line: LaneLine, other: LaneLine) -> bool:
    before, after = line.points[-1] - line.points[-2], other.points[1] - other.points[0]
    return bool(before @ after > STRAIGHT * np.hypot(*before) * np.hypot(*after))


def _append(line: LaneLine, other: LaneLine) -> LaneLine:
    points, solid = np.concatenate((line.points, other.points)), np.concatenate((line.solid, other.solid))
    return LaneLine(points, solid, max(line.width_m, other.width_m))


def _reverse(line: LaneLine) -> LaneLine:
    return LaneLine(line.points[::-1], line.solid[::-1], line.width_m)
