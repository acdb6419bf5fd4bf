"""Plan view of an OpenDRIVE road: its geometry elements in order, and the joints between them (OpenDRIVE 1.8, 9.2)."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flcav.geometry import wrap_angle
from flcav.world.opendrive.reference_line import is_by_length, list_pieces

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
    """Rewrite the plan view of a <road> in place without gaps of `NOTED_M` or more; return the joints worth a word.

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
            shorten(before, min(float(before.attrib["length"]), room))
            out[-1:] = _ease(before, row, room)
        out.append(row)
    view = road.find("planView")
    assert view is not None, "a road that keeps to the standard has a plan view"
    view[:] = out
    return joints


def shorten(row: ElementTree.Element, length: float) -> None:
    """Let a geometry element end at `length` [m], up to which it stays as it is."""
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
    """Return the elements in the place of `before`, over `room` metres of s, whose end is where `row` begins."""
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
        shorten(before, first)
    for i, (dx, dy) in enumerate(np.diff(points, axis=0).tolist()):
        place = {"s": start + first + share[i] * over, "x": points[i, 0], "y": points[i, 1], "hdg": math.atan2(dy, dx)}
        values = place | {"length": over * share[1]}
        out.append(ElementTree.Element("geometry", {name: repr(float(value)) for name, value in values.items()}))
        straight = {name + axis: "0" for name in "abcd" for axis in "UV"} | {"bU": repr(math.hypot(dx, dy))}
        ElementTree.SubElement(out[-1], "paramPoly3", straight | {"pRange": "normalized"})
    return out
