"""Reference lines of OpenDRIVE roads in plan (OpenDRIVE 1.8, 9): their geometry elements, and the joints of these.

Places and headings are in the map's frame: x [m], y [m], and heading [rad] counter-clockwise from x.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flcav.arrays import Array
from flcav.geometry import wrap_angle

Curve = Callable[[Array], tuple[Array, Array, Array]]  # arc length [m] -> u, v [m], direction [rad], from its start

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)  # for the integrals of spirals
TURN_RAD = 0.5  # largest turn of a spiral over one interval of integration
FINE = 400  # number of points at which the length of a cubic is measured
LENGTH_SHARE, LENGTH_M = 0.01, 0.5  # largest relative and absolute error of a length in the map; their sum is allowed


@dataclass(frozen=True)
class GeometryPiece:
    """One <geometry>: a curve and the pose of its start in the map's frame."""

    s: float  # s of the start along the road [m]
    length: float  # length according to the map [m]
    x: float  # x of the start [m]
    y: float  # y of the start [m]
    heading: float  # heading at the start [rad]
    curve: Curve  # shape, with u along the heading at the start and v to its left

    def at(self, along: Array) -> Array:
        """Compute x, y [m] and heading [rad] (N, 3) at `along` (N,) [m] from the start, limited to the length."""
        u, v, turn = self.curve(np.clip(along, 0.0, self.length))
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return np.stack((self.x + cos * u - sin * v, self.y + sin * u + cos * v, self.heading + turn), axis=1)

    def measure(self) -> float:
        """Measure the length of the curve [m], to some millimetres; that of a cubic may differ from the map's."""
        return float(np.hypot(*np.diff(self.at(np.linspace(0.0, self.length, FINE))[:, :2], axis=0).T).sum())


class ReferenceLine:
    """The reference line of one road, by length s along it."""

    def __init__(self, road: ElementTree.Element) -> None:
        """Read the geometry of a <road> that keeps to `standard`."""
        self._pieces = list_pieces(road.iterfind("planView/geometry"))
        self._starts = np.array([piece.s for piece in self._pieces])
        self.length = float(road.attrib["length"])

    def at(self, s: Array) -> Array:
        """Compute x, y [m] and heading [rad] (N, 3) at `s` (N,) [m], limited to the lengths of the pieces."""
        out = np.empty((len(s), 3))
        number = np.clip(np.searchsorted(self._starts, s, side="right") - 1, 0, None)
        for i in np.unique(number).tolist():
            rows = number == i
            piece = self._pieces[i]
            out[rows] = piece.at(s[rows] - piece.s)
        return out


def list_pieces(rows: Iterable[ElementTree.Element]) -> list[GeometryPiece]:
    """Read the pieces of <geometry> elements that keep to `standard`."""
    return [_piece(row) for row in rows]


def is_by_length(shape: ElementTree.Element, length: float) -> bool:
    """Return whether the parameter of a <paramPoly3> goes from 0 to `length` [m] rather than to 1.

    `pRange` decides, or 1 without it, unless the curve has about this length in the other case alone.
    """
    said = shape.get("pRange") == "arcLength"
    polynomials = [np.polynomial.Polynomial([float(shape.attrib[name + axis]) for name in "abcd"]) for axis in "UV"]

    def fits(end: float) -> bool:
        points = np.array([polynomial(np.linspace(0.0, end, FINE)) for polynomial in polynomials])
        return abs(float(np.hypot(*np.diff(points)).sum()) - length) <= LENGTH_M + LENGTH_SHARE * length

    with np.errstate(all="ignore"):  # numbers that overflow
        by_length, by_share = fits(length), fits(1.0)
    return said if by_length == by_share else by_length


def _piece(row: ElementTree.Element) -> GeometryPiece:
    s, x, y, heading, length = (float(row.attrib[name]) for name in ("s", "x", "y", "hdg", "length"))
    shape = next(child for child in row if child.tag in CURVES)
    return GeometryPiece(s, length, x, y, heading, CURVES[shape.tag](shape, length))


def _line(_shape: ElementTree.Element, _length: float) -> Curve:
    return lambda s: (s, np.zeros_like(s), np.zeros_like(s))


def _arc(shape: ElementTree.Element, _length: float) -> Curve:
    return _clothoid(float(shape.attrib["curvature"]), 0.0)


def _spiral(shape: ElementTree.Element, length: float) -> Curve:
    start, end = float(shape.attrib["curvStart"]), float(shape.attrib["curvEnd"])
    return _clothoid(start, (end - start) / length if length else 0.0)


def _clothoid(start: float, rate: float) -> Curve:
    """Build the curve of curvature `start` [1/m] + `rate` [1/m^2] s, by Gauss-Legendre quadrature of its direction."""

    def curve(s: Array) -> tuple[Array, Array, Array]:
        def turn(at: Array) -> Array:
            return at * (start + rate * at / 2)

        most = float(np.abs(s * (np.abs(start) + np.abs(rate * s))).max(initial=0.0))
        parts = int(np.clip(np.ceil(most / TURN_RAD), 1, 1000))
        shares = ((np.arange(parts)[:, None] + (NODES + 1) / 2) / parts).ravel()
        weights = np.tile(WEIGHTS / (2 * parts), parts)
        angles = turn(s[:, None] * shares)
        return s * (np.cos(angles) @ weights), s * (np.sin(angles) @ weights), turn(s)

    return curve


def _poly3(shape: ElementTree.Element, length: float) -> Curve:
    a, b, c, d = (float(shape.attrib[name]) for name in "abcd")
    return _cubic((0.0, 1.0, 0.0, 0.0), (a, b, c, d), length, by_length=True)


def _param_poly3(shape: ElementTree.Element, length: float) -> Curve:
    u, v = ([float(shape.attrib[f"{name}{axis}"]) for name in "abcd"] for axis in "UV")
    scale = 1.0 if not length or is_by_length(shape, length) else 1.0 / length
    along, across = ([value * scale**i for i, value in enumerate(row)] for row in (u, v))
    return _cubic(tuple(along), tuple(across), length, by_length=False)


def _cubic(u: tuple[float, ...], v: tuple[float, ...], length: float, *, by_length: bool) -> Curve:
    """Build the curve of two cubic polynomials in p, where p is s, or with `by_length` the parameter at arc length s.

    `u` and `v` are the coefficients of both, from that of p^0 on.
    """
    along, across = np.polynomial.Polynomial(u), np.polynomial.Polynomial(v)
    slope_u, slope_v = along.deriv(), across.deriv()

    def curve(s: Array) -> tuple[Array, Array, Array]:
        p = s
        if by_length:
            fine = np.linspace(0.0, max(length, 1e-9), FINE)
            steps = np.hypot(np.diff(along(fine)), np.diff(across(fine)))
            p = np.interp(s, np.concatenate(([0.0], np.cumsum(steps))), fine)
        return along(p), across(p), np.arctan2(slope_v(p), slope_u(p))

    return curve


CURVES: dict[str, Callable[[ElementTree.Element, float], Curve]] = {
    "line": _line,
    "arc": _arc,
    "spiral": _spiral,
    "poly3": _poly3,
    "paramPoly3": _param_poly3,
}


SHORTEST_M = 1e-3  # length below which an element is left out
WIDEST_GAP_M = 1.0  # largest gap that is closed
NOTED_M, NOTED_RAD = 0.02, math.radians(5.0)  # smallest gap and kink that are noted
SHARPEST_RAD = math.radians(60.0)  # largest kink of a valid map; the largest in 84 public maps is 45°
EASE = 10.0  # length over which a gap is closed, as a multiple of the gap
STEP_M = 1.0  # largest length of the straight elements that close a gap


@dataclass(frozen=True)
class Joint:
    """The joint of a geometry element with the one before it."""

    s: float  # s of the element [m]
    gap_m: float  # distance from the end of the one before, in plan or along s, whichever is larger
    kink_rad: float  # angle between both headings, from 0 to pi


def order_geometry(road: ElementTree.Element) -> list[ElementTree.Element]:
    """Sort the geometry elements of a <road> by s, without those that have no length.

    The longest one is kept in any case.
    """
    lengths = [(float(row.attrib["length"]), row) for row in road.iterfind("planView/geometry")]
    least = min(SHORTEST_M, max((length for length, _ in lengths), default=0.0))
    return sorted((row for length, row in lengths if length >= least), key=lambda row: float(row.attrib["s"]))


def measure_joints(rows: list[ElementTree.Element]) -> list[Joint]:
    """Measure the joint before each geometry element; that of the first is its distance from s = 0, without a kink."""
    pieces = list_pieces(rows)
    out = [Joint(piece.s, abs(piece.s), 0.0) for piece in pieces[:1]]
    for before, after in pairwise(pieces):
        x, y, heading = before.at(np.array([before.length]))[0].tolist()
        along = abs(before.s + before.length - after.s)
        turn = abs(float(wrap_angle(after.at(np.zeros(1))[0, 2] - heading)))
        begins = after.at(np.zeros(1))[0]
        out.append(Joint(after.s, max(along, math.hypot(begins[0] - x, begins[1] - y)), turn))
    return out


def close_gaps(road: ElementTree.Element) -> list[Joint]:
    """Close gaps of `NOTED_M` or more in the plan view of a <road>, in place; return the joints to report.

    Every element keeps its start and its s. An element that overlaps the next one is cut there, and the last metres
    before a gap are shifted towards the next element, in proportion to s.
    """
    rows = order_geometry(road)
    joints = [joint for joint in measure_joints(rows) if joint.gap_m >= NOTED_M or joint.kink_rad >= NOTED_RAD]
    out = rows[:1]
    out[0].set("s", "0")
    for row in rows[1:]:
        before = out[-1]
        start, room = float(row.attrib["s"]), float(row.attrib["s"]) - float(before.attrib["s"])
        if any(joint.s == start and joint.gap_m >= NOTED_M for joint in joints):
            shorten_geometry(before, min(float(before.attrib["length"]), room))
            out[-1:] = _ease(before, row, room)
        out.append(row)
    view = road.find("planView")
    assert view is not None, "a road that keeps to the standard has a plan view"
    view[:] = out
    return joints


def shorten_geometry(row: ElementTree.Element, length: float) -> None:
    """Cut a geometry element at `length` [m], in place; its shape up to there stays the same."""
    whole = float(row.attrib["length"])
    spiral, cubic = row.find("spiral"), row.find("paramPoly3")
    if spiral is not None:
        first, last = (float(spiral.attrib[name]) for name in ("curvStart", "curvEnd"))
        spiral.set("curvEnd", repr(first + (last - first) * length / whole))
    if cubic is not None and not is_by_length(cubic, whole):
        for i, name in enumerate("abcd"):
            for axis in "UV":
                cubic.set(name + axis, repr(float(cubic.attrib[name + axis]) / whole**i))
        cubic.set("pRange", "arcLength")
    row.set("length", repr(length))


def _ease(before: ElementTree.Element, row: ElementTree.Element, room: float) -> list[ElementTree.Element]:
    """Build elements that replace `before` over `room` [m] of s, and end where `row` begins."""
    (one, other), start = list_pieces([before, row]), float(before.attrib["s"])
    gap = other.at(np.zeros(1))[0, :2] - one.at(np.array([room]))[0, :2]
    over = min(EASE * max(float(np.hypot(*gap)), room - one.length), room)
    if over < NOTED_M:
        return [before]
    first = room - over
    share = np.linspace(0.0, 1.0, math.ceil(over / STEP_M) + 1)
    points = one.at(first + share * (min(one.length, room) - first))[:, :2] + share[:, None] * gap
    out = [before] if first > SHORTEST_M else []
    if out:
        shorten_geometry(before, first)
    for i, (dx, dy) in enumerate(np.diff(points, axis=0).tolist()):
        place = {"s": start + first + share[i] * over, "x": points[i, 0], "y": points[i, 1], "hdg": math.atan2(dy, dx)}
        values = place | {"length": over * share[1]}
        out.append(ElementTree.Element("geometry", {name: repr(float(value)) for name, value in values.items()}))
        straight = {name + axis: "0" for name in "abcd" for axis in "UV"} | {"bU": repr(math.hypot(dx, dy))}
        ElementTree.SubElement(out[-1], "paramPoly3", straight | {"pRange": "normalized"})
    return out
