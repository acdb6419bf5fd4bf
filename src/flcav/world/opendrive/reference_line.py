"""Reference lines of OpenDRIVE roads in plan (OpenDRIVE 1.8, 9): their geometry elements, and the joints of these."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flcav.arrays import Array
from flcav.geometry import wrap_angle

Curve = Callable[[Array], tuple[Array, Array, Array]]  # length along it -> u, v [m], direction [rad], in its own frame

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)  # of the integrals of spirals
TURN_RAD = 0.5  # by which a spiral turns at most over one interval of integration
FINE = 400  # points at which a cubic's length is measured
LENGTH_SHARE, LENGTH_M = 0.01, 0.5  # by which the length of a curve or road may differ from what the map says


@dataclass(frozen=True)
class GeometryPiece:
    """One <geometry>: a curve from a place in the map."""

    s: float  # where it begins along the road [m]
    length: float  # [m]
    x: float  # of its start [m]
    y: float
    heading: float  # of its start [rad]
    curve: Curve

    def at(self, along: Array) -> Array:
        """Return x, y [m] and heading [rad] (N, 3) at `along` (N,) [m] from its start, limited to its length."""
        u, v, turn = self.curve(np.clip(along, 0.0, self.length))
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return np.stack((self.x + cos * u - sin * v, self.y + sin * u + cos * v, self.heading + turn), axis=1)

    def measure(self) -> float:
        """Return the length of the curve [m], to some millimetres; a cubic's may differ from what the map says."""
        return float(np.hypot(*np.diff(self.at(np.linspace(0.0, self.length, FINE))[:, :2], axis=0).T).sum())


class ReferenceLine:
    """The reference line of one road, by length s along it."""

    def __init__(self, road: ElementTree.Element) -> None:
        """Read the geometry of a <road> that keeps to `standard`."""
        self._pieces = list_pieces(road.iterfind("planView/geometry"))
        self._starts = np.array([piece.s for piece in self._pieces])
        self.length = float(road.attrib["length"])

    def at(self, s: Array) -> Array:
        """Return x, y [m] and heading [rad] (N, 3) at `s` (N,) [m], limited to each piece's length."""
        out = np.empty((len(s), 3))
        number = np.clip(np.searchsorted(self._starts, s, side="right") - 1, 0, None)
        for i in np.unique(number).tolist():
            rows, piece = number == i, self._pieces[i]
            out[rows] = piece.at(s[rows] - piece.s)
        return out


def list_pieces(rows: Iterable[ElementTree.Element]) -> list[GeometryPiece]:
    """Return the curves of <geometry> elements that keep to `standard`."""
    return [_piece(row) for row in rows]


def is_by_length(shape: ElementTree.Element, length: float) -> bool:
    """Return whether the parameter of a <paramPoly3> goes to `length` [m] rather than to 1.

    That is what its `pRange` says, without one 1, unless the curve has about this length in the other case alone.
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
    """Return the curve of curvature `start` + `rate` s, by Gauss-Legendre quadrature of its direction."""

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
    """Return the curve of two cubic polynomials in p; p is s, or with `by_length` the parameter at arc length s."""
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


SHORTEST_M = 1e-3  # a shorter element is left out
WIDEST_GAP_M = 1.0  # of a gap that is closed
NOTED_M, NOTED_RAD = 0.02, math.radians(5.0)  # smallest gap and kink worth a word
SHARPEST_RAD = math.radians(60.0)  # of a kink; the sharpest of 84 maps of others has 45°
EASE = 10.0  # length over which a gap is closed, as a multiple of it
STEP_M = 1.0  # length of the straight elements there, at most


@dataclass(frozen=True)
class Joint:
    """The joint before a geometry element: how far it begins from where the one before it ends."""

    s: float  # [m]
    gap_m: float  # in plan or along s, whichever is larger
    kink_rad: float  # between their headings, from 0 to pi


def order_geometry(road: ElementTree.Element) -> list[ElementTree.Element]:
    """Return the geometry elements of a <road> in the order of s, without those that have no length.

    The longest is among them in any case.
    """
    lengths = [(float(row.attrib["length"]), row) for row in road.iterfind("planView/geometry")]
    least = min(SHORTEST_M, max((length for length, _ in lengths), default=0.0))
    return sorted((row for length, row in lengths if length >= least), key=lambda row: float(row.attrib["s"]))


def measure_joints(rows: list[ElementTree.Element]) -> list[Joint]:
    """Return the joint before each geometry element, the first of which begins at s = 0 and has no kink."""
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
    """Rewrite the plan view of a <road> in place without gaps of `NOTED_M` or more; return the joints to report.

    Each element begins where the file says, at its s. One that overlaps the next ends there, and the last metres before
    a gap are shifted towards the next element, in proportion to s.
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
    """Cut a geometry element at `length` [m], in place; up to there its shape stays."""
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
    """Return elements that replace `before` over `room` [m] of s, and end where `row` begins."""
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
