"""Widths of the lanes of an OpenDRIVE road as netconvert needs them: no borders, none below zero (OpenDRIVE 1.8, 11.6).

netconvert ignores borders, gives a lane without a positive width a usual one, and looks at a width only where an
element of the map begins or ends.
"""

import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

LEAST_M = 1e-3  # a lane that is nowhere wider has no width, and a width less below zero needs no cut
LATE_M = 0.5  # widths that begin up to here count from the beginning of their section
NARROW_M = 1.8  # width from which on netconvert opens a lane to traffic
ZERO = Polynomial([0.0])


class Piece(NamedTuple):
    """A piece of a piecewise polynomial: its value [m] by the length [m] from `s` on."""

    s: float  # [m] from the beginning of the lane section
    value: Polynomial

    def at(self, s: float) -> "Piece":
        """Return the same polynomial from another place on."""
        return self if s == self.s else Piece(s, self.value(Polynomial([s - self.s, 1.0])))


class Change(NamedTuple):
    """What was changed of the width of a lane."""

    lane: int
    least_m: float  # below zero: the least width, before it was cut there; 0 for a lane without a positive width


def rewrite_widths(section: ElementTree.Element, length: float) -> list[Change]:
    """Rewrite the widths of a <laneSection> of `length` [m] in place; return the changes worth a word.

    Borders become widths, a width below zero is zero, and so is a missing one: netconvert leaves such a lane out.
    """
    changes = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        lanes = sorted(section.iterfind(f"{side}/lane"), key=lambda lane: abs(int(lane.attrib["id"])))
        bordered = any(lane.find("border") is not None for lane in lanes)
        edge = [Piece(0.0, ZERO)]  # from the centre line to the outer border of the lane before
        for lane in lanes:
            widths, borders = lane.findall("width"), lane.findall("border")
            if not bordered and _is_plain(widths):
                continue
            pieces = _read(widths)
            if borders and not widths:
                pieces = _add(_add([Piece(0.0, ZERO)], _read(borders), sign), edge, -1.0)
            kept, least, most = _cut(pieces, length)
            if most <= LEAST_M or least < -LEAST_M:
                changes.append(Change(int(lane.attrib["id"]), least if most > LEAST_M else 0.0))
            if kept != pieces or [one.s for one in kept] != [float(row.attrib["sOffset"]) for row in widths]:
                for row in widths + borders:
                    lane.remove(row)
                for one in kept:
                    ElementTree.SubElement(lane, "width", _write(one))
            edge = _add(edge, kept, 1.0) if bordered else edge
    return changes


def _is_plain(widths: list[ElementTree.Element]) -> bool:
    """Return whether a lane has one positive width all along, as most have."""
    own = [[float(row.attrib[name]) for name in ("sOffset", *"abcd")] for row in widths]
    return len(own) == 1 and own[0][0] == 0.0 and own[0][1] > LEAST_M and not any(own[0][2:])


def _cut(pieces: list[Piece], length: float) -> tuple[list[Piece], float, float]:
    """Return the pieces up to `length` [m], zero where they are below it, and the least and the largest value [m].

    A piece also ends where it is narrowest, if no vehicle fits there.
    """
    parts, ends = [], [*(piece.s for piece in pieces[1:]), length]
    for piece, end in zip(pieces, ends):
        flat = not piece.value.coef[1:].any()
        turning = [] if flat else _find_roots(piece.value.deriv(), end - piece.s)
        turns = [turn for turn in turning if piece.value(turn) < NARROW_M]
        cuts = [0.0, *sorted({*_find_roots(piece.value, end - piece.s), *turns}), end - piece.s]
        parts += [(piece.at(piece.s + cut), till - cut) for cut, till in pairwise(cuts) if till > cut]
    values = np.array([piece.value(np.linspace(0.0, span, 3)) for piece, span in parts])
    least, most = float(values.min()), float(values.max())
    if most <= LEAST_M:
        return [Piece(0.0, ZERO)], least, most
    below = values[:, 1] < (0.0 if least < -LEAST_M else -np.inf)
    return [Piece(piece.s, ZERO) if negative else piece for (piece, _), negative in zip(parts, below)], least, most


def _find_roots(value: Polynomial, span: float) -> list[float]:
    """Return where a polynomial is zero, above 0 and below `span`."""
    if not value.coef[1:].any() or not np.isfinite(value.coef).all():
        return []
    roots = value.trim(1e-12).roots()
    return [float(root.real) for root in roots if abs(root.imag) < 1e-9 and 1e-6 < root.real < span - 1e-6]


def _read(rows: list[ElementTree.Element]) -> list[Piece]:
    """Return the pieces of rows in the order of s, from the beginning of the section on."""
    pieces = [Piece(float(row.attrib["sOffset"]), Polynomial([float(row.attrib[i]) for i in "abcd"])) for row in rows]
    early = [piece for piece in pieces if piece.s <= 0.0]
    late = [piece for piece in pieces if piece.s > 0.0]
    if early:
        return [early[-1].at(0.0), *late]
    if late and late[0].s <= LATE_M:
        return [late[0]._replace(s=0.0), *late[1:]]
    return [Piece(0.0, ZERO), *late]


def _add(one: list[Piece], other: list[Piece], factor: float) -> list[Piece]:
    """Return the pieces of one piecewise polynomial plus `factor` times another."""
    starts = sorted({piece.s for piece in (*one, *other)})
    return [Piece(s, _at(one, s).value + factor * _at(other, s).value) for s in starts]


def _at(pieces: list[Piece], s: float) -> Piece:
    return [piece for piece in pieces if piece.s <= s][-1].at(s)


def _write(piece: Piece) -> dict[str, str]:
    """Return the attributes of a <width>."""
    coefficients = [*piece.value.coef.tolist(), 0.0, 0.0, 0.0][:4]
    return {"sOffset": repr(piece.s), **{name: repr(value) for name, value in zip("abcd", coefficients)}}
