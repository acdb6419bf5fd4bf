"""Mending of the roads of an OpenDRIVE map: order along s, gaps in reference lines, widths of lanes, speed limits."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from flcav.config import shorten
from flcav.world.opendrive.document import FASTEST, TO_METRES_PER_SECOND
from flcav.world.opendrive.mending.lane_widths import rewrite_widths
from flcav.world.opendrive.objects.places import read_number
from flcav.world.opendrive.plan_view import NOTED_M, NOTED_RAD, SHORTEST_M, close_gaps, order_geometry
from flcav.world.opendrive.reference_line import is_by_length

STRAIGHT = 1e-9  # least curvature, and difference between two [1/m]
MOST_TOLD = 10  # changes of a kind that are told one by one
PROFILES = ("planView", "elevationProfile", "lateralProfile", "lanes")  # children of a <road> with elements along s


def mend_roads(root: ElementTree.Element) -> tuple[str, ...]:
    """Mend the roads of the map below `root`, which keeps to `standard`, in place; return a note on each change.

    Elements along a road are sorted by s, those without a length are left out, gaps between geometry elements are
    closed, widths are rewritten for netconvert, and speed limits that are none are removed. Of many changes of a kind
    `MOST_TOLD` are told.
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
    return tuple(note for own in notes for note in _shorten_list(own))


def _shorten_list(notes: list[str]) -> list[str]:
    more = len(notes) - MOST_TOLD
    return notes if more < 2 else [*notes[:MOST_TOLD], f"... and {more} more changes like the last one."]


def _sort(road: ElementTree.Element) -> list[tuple[str, str]]:
    """Sort the elements along a road by s, in place, all but lateral shapes, and lanes by their number.

    Return the lanes, as ", lane -1" or "" for the road itself, and names of elements that were not in order.
    """
    found = []
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
                found.append((where, tag))
                places = [i for i, row in enumerate(parent) if row.tag == tag]
                for i, row in zip(places, ordered):
                    parent[i] = row
    return found


def _drop_empty(road: ElementTree.Element) -> Iterator[tuple[str, float]]:
    """Remove geometry and lane sections, in order of s, that have no length; yield the name and s [m] of each."""
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
    """Return the lane sections of a road, in order of s, and their lengths [m]."""
    sections = road.findall("lanes/laneSection")
    ends = [*(float(section.attrib["s"]) for section in sections), float(road.attrib["length"])]
    return [(section, end - start) for section, (start, end) in zip(sections, pairwise(ends))]


def _write_shapes(road: ElementTree.Element) -> None:
    """Write at each <paramPoly3> how far its parameter goes, and spirals of one curvature, and arcs of none, as others.

    netconvert takes the one at its word, and divides by zero at the others.
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
    """Rewrite the widths of a road's lanes; yield a note on each lane that is cut or left out."""
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
    """Remove the speed limits of a road and its lanes that say a number but no speed; yield a note on each."""
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
