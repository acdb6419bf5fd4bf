"""Reference lines of OpenDRIVE roads in the plane (OpenDRIVE 1.8, 9): line, arc, spiral, poly3 and paramPoly3."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Curve = Callable[[Array], tuple[Array, Array, Array]]  # length along it -> u, v [m], direction [rad], in its own frame

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)  # of the integrals of spirals
TURN_RAD = 0.5  # by which a spiral turns at most over one interval of integration
FINE = 400  # points at which a cubic's length is measured


@dataclass(frozen=True)
class _Piece:
    """One <geometry>: a curve from a place in the map."""

    s: float  # where it begins along the road [m]
    length: float  # [m]
    x: float  # of its start [m]
    y: float
    heading: float  # of its start [rad]
    curve: Curve


class ReferenceLine:
    """The reference line of one road, by length s along it."""

    def __init__(self, road: ElementTree.Element) -> None:
        """Read the geometry of a <road> that keeps to `standard`."""
        self._pieces = [_piece(row) for row in road.iterfind("planView/geometry")]
        self._starts = np.array([piece.s for piece in self._pieces])
        self.length = float(road.attrib["length"])

    def at(self, s: Array) -> Array:
        """Return x, y [m] and heading [rad] (N, 3) at `s` (N,) [m], limited to each piece's length."""
        out = np.empty((len(s), 3))
        number = np.clip(np.searchsorted(self._starts, s, side="right") - 1, 0, None)
        for i in np.unique(number).tolist():
            rows, piece = number == i, self._pieces[i]
            u, v, turn = piece.curve(np.clip(s[rows] - piece.s, 0.0, piece.length))
            cos, sin = np.cos(piece.heading), np.sin(piece.heading)
            out[rows] = np.stack(
                (piece.x + cos * u - sin * v, piece.y + sin * u + cos * v, piece.heading + turn), axis=1
            )
        return out


def _piece(row: ElementTree.Element) -> _Piece:
    s, x, y, heading, length = (float(row.attrib[name]) for name in ("s", "x", "y", "hdg", "length"))
    shape = next(child for child in row if child.tag in CURVES)
    return _Piece(s, length, x, y, heading, CURVES[shape.tag](shape, length))


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
    scale = 1.0 if shape.get("pRange") == "arcLength" or not length else 1.0 / length
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
