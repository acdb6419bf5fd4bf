"""Mending of OpenDRIVE maps before they are read: roads, widths of lanes, and content that netconvert requires.

Broken content is removed, and optional content that netconvert requires is completed: a type of the centre lane (ASAM
OpenDRIVE 1.8, 11.3), the contact point of a connection (12.4), and restrictions of access as attributes, as in edition
1.7 (11.8.2).

Lanes get widths instead of borders, and none below zero (11.6): netconvert ignores borders, gives a lane without a
positive width a default one, and evaluates a width only where an element of the map begins or ends.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from flcav.config import shorten
from flcav.world.opendrive.document import FASTEST, TO_METRES_PER_SECOND
from flcav.world.opendrive.objects.places import read_number
from flcav.world.opendrive.reference_line import (
    NOTED_M,
    NOTED_RAD,
    SHORTEST_M,
    close_gaps,
    is_by_length,
    order_geometry,
)

STRAIGHT = 1e-9  # least curvature of an arc, and least change of curvature of a spiral [1/m]
MOST_TOLD = 10  # number of changes of a kind that are listed one by one
PROFILES = ("planView", "elevationProfile", "lateralProfile", "lanes")  # children of a <road> with elements along s


def mend_roads(root: ElementTree.Element) -> tuple[str, ...]:
    """Mend the roads of the map below `root`, which keeps to `standard`, in place; return notes on the changes.

    Elements along a road are sorted by s, elements without a length are removed, gaps between geometry elements are
    closed, widths are rewritten for netconvert, and invalid speed limits are removed. Of many changes of a kind, the
    first `MOST_TOLD` are listed.
    """
    notes: list[list[str]] = [[] for _ in range(6)]
    order, empty, gaps, kinks, widths, limits = notes
    for road in root.iterfind("road"):
        name = f"Road {shorten(road.get('id', ''))}"
        order += [f"{name}{lane}: its <{tag}> elements were not in the order of s." for lane, tag in _sort(road)]
        empty += [f"{name}: left out, the <{tag}> of no length at s = {s:g} m." for tag, s in _drop_empty(road)]
        road.set("junction", road.get("junction", "-1"))
        _write_shapes(road)
        for joint in sorted(close_gaps(road), key=lambda joint: -joint.gap_m):
            here = f"{name}: at s = {joint.s:.6g} m its geometry"
            if joint.gap_m >= NOTED_M:
                gaps.append(f"{here} begins {joint.gap_m:.2g} m from where the one before it ends: joined.")
            if joint.kink_rad >= NOTED_RAD:
                kinks.append(f"{here} turns by {math.degrees(joint.kink_rad):.0f}° at once.")
        widths += [f"{name}, {note}" for note in _mend_widths(road)]
        limits += [f"{name}{note}" for note in _drop_limits(road)]
    return tuple(note for group in notes for note in _shorten_list(group))


def _shorten_list(notes: list[str]) -> list[str]:
    more = len(notes) - MOST_TOLD
    return notes if more < 2 else [*notes[:MOST_TOLD], f"... and {more} more changes like the last one."]


def _sort(road: ElementTree.Element) -> list[tuple[str, str]]:
    """Sort the elements along a road by s, and by t at the same s, and its lanes by their number, in place.

    Return the lane (", lane -1", or "" for the road itself) and name of elements that were not in order.
    """
    unordered = []
    parents = [("", parent) for tag in PROFILES for parent in road.iterfind(tag)]
    for section in road.iterfind("lanes/laneSection"):
        for side in section:
            if side.tag in ("left", "right"):
                side[:] = sorted(side, key=lambda lane: -int(lane.attrib["id"]) if lane.tag == "lane" else 0)
            parents += [(f", lane {lane.get('id')}", lane) for lane in side.iterfind("lane")]
    for where, parent in [("", road), *parents]:
        starts = {
            row.tag: "s" if "s" in row.attrib else "sOffset" for row in parent if {"s", "sOffset"} & {*row.keys()}
        }
        for tag, start in starts.items():
            rows = parent.findall(tag)
            ordered = sorted(rows, key=lambda row: (read_number(row, start), read_number(row, "t")))
            if any(one is not other for one, other in zip(rows, ordered)):
                unordered.append((where, tag))
                places = [i for i, row in enumerate(parent) if row.tag == tag]
                for i, row in zip(places, ordered):
                    parent[i] = row
    return unordered


def _drop_empty(road: ElementTree.Element) -> Iterator[tuple[str, float]]:
    """Remove geometry and lane sections (in the order of s) without a length; yield the name and s [m] of each."""
    kept = order_geometry(road)
    for row in road.findall("planView/geometry"):
        if row not in kept:
            yield "geometry", float(row.attrib["s"])
    lanes, sections = road.find("lanes"), road.findall("lanes/laneSection")
    assert lanes is not None, "a road that keeps to the standard has lanes"
    for section, length in _measure(road)[::-1]:
        if length <= SHORTEST_M and len(sections) > 1:
            sections.remove(section)
            lanes.remove(section)
            yield "laneSection", float(section.attrib["s"])
    sections[0].set("s", "0")


def _measure(road: ElementTree.Element) -> list[tuple[ElementTree.Element, float]]:
    """Return the lane sections of a road and their lengths [m]; they are in the order of s."""
    sections = road.findall("lanes/laneSection")
    ends = [*(float(section.attrib["s"]) for section in sections), float(road.attrib["length"])]
    return [(section, end - start) for section, (start, end) in zip(sections, pairwise(ends))]


def _write_shapes(road: ElementTree.Element) -> None:
    """Write the range of each <paramPoly3>; turn spirals of constant curvature into arcs, straight arcs into lines.

    netconvert relies on the range without checking it, and divides by zero in the other two cases.
    """
    for row in road.iterfind("planView/geometry"):
        for shape in row:
            if shape.tag == "paramPoly3":
                by_length = is_by_length(shape, float(row.attrib["length"]))
                shape.set("pRange", "arcLength" if by_length else "normalized")
            if shape.tag == "spiral":
                start, end = (float(shape.attrib[name]) for name in ("curvStart", "curvEnd"))
                if abs(end - start) < STRAIGHT:
                    shape.tag, shape.attrib = "arc", {"curvature": repr(start)}
            if shape.tag == "arc" and abs(float(shape.attrib["curvature"])) < STRAIGHT:
                shape.tag, shape.attrib = "line", {}


def _mend_widths(road: ElementTree.Element) -> Iterator[str]:
    """Rewrite the widths of a road's lanes in place; yield a note on each lane that is cut or left out."""
    several = len(road.findall("lanes/laneSection")) > 1
    for section, length in _measure(road):
        kinds = {lane.get("id"): lane.get("type") or "none" for lane in section.iterfind("*/lane")}
        with np.errstate(all="ignore"):  # numbers that overflow
            changes = rewrite_widths(section, length)
        for lane, least_m in changes:
            where = f"lane {lane}" + (f" from s = {float(section.attrib['s']):g} m on" if several else "")
            if least_m:
                yield f"{where}: its width falls to {least_m:.2g} m: cut at zero."
            elif kinds[str(lane)] != "none":
                yield f"{where}: left out, it has no positive width."


def _drop_limits(road: ElementTree.Element) -> Iterator[str]:
    """Remove speed limits with an unknown unit or an invalid value from a road and its lanes; yield a note on each."""
    owners = [("", owner) for owner in road.iterfind("type")]
    owners += [(f", lane {lane.get('id')}", lane) for lane in road.iterfind("lanes/laneSection/*/lane")]
    for where, owner in owners:
        for limit in owner.findall("speed"):
            most, unit = read_number(limit, "max", math.nan), limit.get("unit") or "m/s"
            if unit not in TO_METRES_PER_SECOND and not math.isnan(most):
                known = ", ".join(TO_METRES_PER_SECOND)
                yield f"{where}: left out, its speed limit of {most:g} {shorten(unit)} (known units: {known})."
            elif most < 0 or most * TO_METRES_PER_SECOND.get(unit, 0.0) > FASTEST:
                yield f"{where}: left out, its speed limit of {most:g} {unit}, which is none."
            else:
                continue
            owner.remove(limit)


LEAST_M = 1e-3  # width up to which a lane has none; a width below zero by less is not cut
LATE_M = 0.5  # largest sOffset of a first width that counts from the beginning of its section
NARROW_M = 1.8  # least width of a lane that netconvert opens to traffic
ZERO = Polynomial([0.0])


class WidthPiece(NamedTuple):
    """A piece of a piecewise polynomial along a lane section."""

    s: float  # start of the piece, from the beginning of the lane section [m]
    value: Polynomial  # value [m] by the distance from `s` [m]

    def at(self, s: float) -> "WidthPiece":
        """Shift the origin of the polynomial to another `s` [m]; its values stay the same."""
        return self if s == self.s else WidthPiece(s, self.value(Polynomial([s - self.s, 1.0])))


class Change(NamedTuple):
    """A change of the width of a lane."""

    lane: int  # number of the lane
    least_m: float  # least width before it was cut at zero, negative; 0 for a lane without a positive width


def rewrite_widths(section: ElementTree.Element, length: float) -> list[Change]:
    """Rewrite the widths of a <laneSection> of `length` [m] in place; return the changes to report.

    Borders become widths, and negative or missing widths become zero, so that netconvert leaves such a lane out.
    """
    changes = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        lanes = sorted(section.iterfind(f"{side}/lane"), key=lambda lane: abs(int(lane.attrib["id"])))
        bordered = any(lane.find("border") is not None for lane in lanes)
        edge = [WidthPiece(0.0, ZERO)]  # from the centre line to the outer border of the lane before
        for lane in lanes:
            widths, borders = lane.findall("width"), lane.findall("border")
            if not bordered and _is_plain(widths):
                continue
            pieces = _read(widths)
            if borders and not widths:
                pieces = _add(_add([WidthPiece(0.0, ZERO)], _read(borders), sign), edge, -1.0)
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
    """Return whether a lane has a single constant positive width, as most lanes have."""
    numbers = [[float(row.attrib[name]) for name in ("sOffset", *"abcd")] for row in widths]
    return len(numbers) == 1 and numbers[0][0] == 0.0 and numbers[0][1] > LEAST_M and not any(numbers[0][2:])


def _cut(pieces: list[WidthPiece], length: float) -> tuple[list[WidthPiece], float, float]:
    """Cut the pieces at `length` [m] and their values at zero; return also their least and largest value before [m].

    A piece is also split where it is narrowest, if no vehicle fits there.
    """
    parts = []
    ends = [*(piece.s for piece in pieces[1:]), length]
    for piece, end in zip(pieces, ends):
        flat = not piece.value.coef[1:].any()
        turning = [] if flat else _find_roots(piece.value.deriv(), end - piece.s)
        turns = [turn for turn in turning if piece.value(turn) < NARROW_M]
        cuts = [0.0, *sorted({*_find_roots(piece.value, end - piece.s), *turns}), end - piece.s]
        parts += [(piece.at(piece.s + cut), till - cut) for cut, till in pairwise(cuts) if till > cut]
    values = np.array([piece.value(np.linspace(0.0, span, 3)) for piece, span in parts])
    least, most = float(values.min()), float(values.max())
    if most <= LEAST_M:
        return [WidthPiece(0.0, ZERO)], least, most
    below = values[:, 1] < (0.0 if least < -LEAST_M else -np.inf)
    return [WidthPiece(piece.s, ZERO) if negative else piece for (piece, _), negative in zip(parts, below)], least, most


def _find_roots(value: Polynomial, span: float) -> list[float]:
    """Find the roots of a polynomial between 0 and `span`, both excluded."""
    if not value.coef[1:].any() or not np.isfinite(value.coef).all():
        return []
    roots = value.trim(1e-12).roots()
    return [float(root.real) for root in roots if abs(root.imag) < 1e-9 and 1e-6 < root.real < span - 1e-6]


def _read(rows: list[ElementTree.Element]) -> list[WidthPiece]:
    """Read the pieces of rows that are in the order of s; the first piece begins at 0."""
    pieces = [
        WidthPiece(float(row.attrib["sOffset"]), Polynomial([float(row.attrib[i]) for i in "abcd"])) for row in rows
    ]
    early = [piece for piece in pieces if piece.s <= 0.0]
    late = [piece for piece in pieces if piece.s > 0.0]
    if early:
        return [early[-1].at(0.0), *late]
    if late and late[0].s <= LATE_M:
        return [late[0]._replace(s=0.0), *late[1:]]
    return [WidthPiece(0.0, ZERO), *late]


def _add(one: list[WidthPiece], other: list[WidthPiece], factor: float) -> list[WidthPiece]:
    """Compute one piecewise polynomial plus `factor` times another."""
    starts = sorted({piece.s for piece in (*one, *other)})
    return [WidthPiece(s, _at(one, s).value + factor * _at(other, s).value) for s in starts]


def _at(pieces: list[WidthPiece], s: float) -> WidthPiece:
    return [piece for piece in pieces if piece.s <= s][-1].at(s)


def _write(piece: WidthPiece) -> dict[str, str]:
    """Format a piece as the attributes of a <width>."""
    coefficients = [*piece.value.coef.tolist(), 0.0, 0.0, 0.0][:4]
    return {"sOffset": repr(piece.s), **{name: repr(value) for name, value in zip("abcd", coefficients)}}


SIGNAL = {"type": "-1", "dynamic": "no", "orientation": "none"}  # defaults of a signal's attributes; type -1: no type
ENDS = ("predecessor", "successor")


def mend_map(root: ElementTree.Element) -> tuple[str, ...]:
    """Mend signals, links, connections and limits of the map below `root` in place; return a note per kind of change.

    Signals get the attributes of `SIGNAL` that they lack; links and connections that lead nowhere, and infinite limits,
    are removed. What netconvert requires beyond the standard is completed without a note.
    """
    roads = {row.get("id", "") for row in root.iterfind("road")}
    known = {"road": roads, "junction": {row.get("id", "") for row in root.iterfind("junction")}}
    untyped = dangling = endless = unknown = direct = 0  # signals, links, speed limits, lanes, connections
    for road in root.iterfind("road"):
        unknown += _type_lanes(road)
        _split_restrictions(road)
        for signal in road.iterfind("signals/signal"):
            untyped += not signal.get("type")
            for name, value in {"id": f"unnamed{untyped}", **SIGNAL}.items():
                signal.set(name, signal.get(name) or value)
        link = road.find("link")
        for end in list(link) if link is not None else []:
            if end.tag in ENDS and end.get("elementId") not in known.get(end.get("elementType", ""), ()):
                link.remove(end)  # pyright: ignore[reportOptionalMemberAccess]
                dangling += 1
        dangling += _clear_lane_links(road)
        endless += _clear_endless_limits(road)
    before = {road.get("id", ""): _find_predecessor(road) for road in root.iterfind("road")}
    for junction in root.iterfind("junction"):
        for row in junction.findall("connection"):
            if not row.get("contactPoint"):
                begins = before.get(row.get("connectingRoad", "")) == row.get("incomingRoad")
                row.set("contactPoint", "start" if begins else "end")
            ways = [lane for lane in row.iterfind("laneLink") if _is_integer(lane, "from") and _is_integer(lane, "to")]
            if {row.get("incomingRoad"), row.get("linkedRoad")} <= roads:
                junction.remove(row)
                direct += 1
            elif not {row.get("incomingRoad"), row.get("connectingRoad")} <= roads:
                junction.remove(row)
                dangling += 1
            elif len(ways) < len(row.findall("laneLink")):
                for lane in row.findall("laneLink"):
                    if lane not in ways:
                        row.remove(lane)
    notes = (
        (untyped, f"Signals without a type: {untyped}; they have no meaning here."),
        (dangling, f"Links that lead to no road, junction or lane of the map, left out: {dangling}."),
        (endless, f"Speed limits that are not finite, left out: {endless}."),
        (direct, f"Connections of direct junctions: {direct}; their lanes are joined by where they lie."),
        (unknown, f"Lanes without a type, closed to traffic: {unknown}."),
    )
    return tuple(note for count, note in notes if count)


def _type_lanes(road: ElementTree.Element) -> int:
    """Set the type "none" where a lane has no type; return the number of those lanes that are not a centre lane."""
    unknown = 0
    for side in road.iterfind("lanes/laneSection/*"):
        for lane in side.iterfind("lane"):
            if not lane.get("type"):
                lane.set("type", "none")
                unknown += side.tag != "center"
    return unknown


def _split_restrictions(road: ElementTree.Element) -> None:
    """Rewrite each <access> of edition 1.8 as one <access> of edition 1.7 per <restriction> that it contains."""
    for lane in road.iterfind("lanes/laneSection/*/lane"):
        for access in lane.findall("access"):
            if access.get("restriction"):
                continue
            at = list(lane).index(access)
            lane.remove(access)
            for restriction in access.iterfind("restriction"):
                values = {**access.attrib, "restriction": restriction.get("type", "")}
                lane.insert(at, ElementTree.Element("access", values))


def _find_predecessor(road: ElementTree.Element) -> str | None:
    """Return the id of the road that precedes a road; None without one."""
    before = road.find("link/predecessor[@elementType='road']")
    return None if before is None else before.get("elementId")


def _clear_lane_links(road: ElementTree.Element) -> int:
    """Remove links of lanes whose id is no integer; return their number."""
    removed = 0
    for link in road.iterfind("lanes/laneSection/*/lane/link"):
        for end in list(link):
            if end.tag in ENDS and not _is_integer(end, "id"):
                link.remove(end)
                removed += 1
    return removed


def _clear_endless_limits(road: ElementTree.Element) -> int:
    """Remove speed limits that are infinite or NaN; return their number. Words like "no limit" stay."""
    removed = 0
    for owner in [*road.iterfind("type"), *road.iterfind("lanes/laneSection/*/lane")]:
        for limit in owner.findall("speed"):
            try:
                endless = not math.isfinite(float(limit.get("max", "")))
            except ValueError:
                continue
            if endless:
                owner.remove(limit)
                removed += 1
    return removed


def _is_integer(row: ElementTree.Element, name: str) -> bool:
    return row.get(name, "").removeprefix("-").isascii() and row.get(name, "").removeprefix("-").isdigit()
