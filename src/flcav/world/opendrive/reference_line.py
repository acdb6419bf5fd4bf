"""Reference lines of OpenDRIVE roads in the plane (OpenDRIVE 1.8, 9): line, arc, spiral, poly3 and paramPoly3."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Curve = Callable[[Array], tuple[Array, Array, Array]]  # length along it -> u, v [m], direction [rad], in its own frame

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)  # of the integrals of spirals
TURN_RAD = 0.5  # by which a spiral turns at most over one interval of integration
FINE = 400  # points at which a cubic's length is measured
LENGTH_SHARE, LENGTH_M = 0.01, 0.5  # by which the length of a curve or road may differ from what the map says


@dataclass(frozen=True)
class Piece:
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


def list_pieces(rows: Iterable[ElementTree.Element]) -> list[Piece]:
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


def _piece(row: ElementTree.Element) -> Piece:
    s, x, y, heading, length = (float(row.attrib[name]) for name in ("s", "x", "y", "hdg", "length"))
    shape = next(child for child in row if child.tag in CURVES)
    return Piece(s, length, x, y, heading, CURVES[shape.tag](shape, length))


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
    """Return the curve of two cubic polynomials in p: p is s itself, or with `by_length` where s has been gone."""
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
