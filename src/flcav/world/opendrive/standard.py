"""Check of a map against the rules of the OpenDRIVE standard that the import relies on (ASAM OpenDRIVE 1.8).

A map that breaks one of them is refused with the rule's clause; other errors and omissions are mended (`mending`).
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flcav.config import InputError, shorten
from flcav.world.opendrive.reference_line import (
    LENGTH_M,
    LENGTH_SHARE,
    SHARPEST_RAD,
    WIDEST_GAP_M,
    list_pieces,
    measure_joints,
    order_geometry,
)

LINES, ROADS = "9.2", "10.1"  # clauses of the standard, as the constants of the next line
ELEVATIONS, NUMBERS, LANES, WIDTHS, OFFSETS, JUNCTIONS = "10.5", "11.1", "11.3", "11.6", "11.4", "12.2"
SHAPES: dict[str, tuple[str, ...]] = {  # child of <geometry> -> its coefficients
    "line": (),
    "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"),
    "poly3": tuple("abcd"),
    "paramPoly3": (*(f"{name}U" for name in "abcd"), *(f"{name}V" for name in "abcd")),
}
POLYNOMIALS: dict[str, tuple[str, str]] = {  # element with a cubic polynomial -> clause, attribute of its start
    "elevationProfile/elevation": (ELEVATIONS, "s"),
    "lateralProfile/superelevation": (ELEVATIONS, "s"),
    "lateralProfile/shape": (ELEVATIONS, "s"),
    "lanes/laneOffset": (OFFSETS, "s"),
}
FARTHEST_M = 1e7  # largest coordinate of a map; coordinates in a zone of UTM reach it
WIDEST_M = 100.0  # largest width of a lane where a width or border begins
EARLIEST_M = 1.0  # largest s of a road's first lane section
LONGEST_M = 1e6  # largest total length of all roads


class _Broken(ValueError):
    """A broken rule; the message is the sentence without the file's name."""


def check_standard(root: ElementTree.Element, path: Path) -> None:
    """Check the map below `root`; raises `InputError` with the clause for the first rule that it breaks."""
    try:
        _check(root)
    except _Broken as error:
        raise InputError(f"{path}: {error}") from None


def _check(root: ElementTree.Element) -> None:
    roads = root.findall("road")
    _refuse_twice("road", roads, ROADS)
    _refuse_twice("junction", root.findall("junction"), JUNCTIONS)
    total = 0.0
    for road in roads:
        name = f"road {shorten(road.get('id', ''))}"
        _check_reference_line(road, name)
        for where, (clause, start) in POLYNOMIALS.items():
            for row in road.iterfind(where):
                _numbers(row, (start, *"abcd"), name, clause)
        _check_lanes(road, name)
        total += float(road.attrib["length"])
    if total > LONGEST_M:
        raise _Broken(f"its roads are {total / 1000:.0f} km long; supported: {LONGEST_M / 1000:.0f} km")


def _refuse_twice(kind: str, rows: list[ElementTree.Element], clause: str) -> None:
    seen: set[str] = set()
    for row in rows:
        name = row.get("id", "")
        if not name or name in seen:
            what = "two have" if name else "one lacks"
            raise _Broken(f"each {kind} needs an id of its own, and {what} {shorten(name)} (OpenDRIVE 1.8, {clause})")
        seen.add(name)


def _check_reference_line(road: ElementTree.Element, name: str) -> None:
    rows = road.findall("planView/geometry")
    if not rows:
        raise _Broken(f"{name} has no <geometry> (OpenDRIVE 1.8, {LINES})")
    (length,) = _numbers(road, ("length",), name, ROADS)
    for row in rows:
        _, x, y, _, measured = _numbers(row, ("s", "x", "y", "hdg", "length"), name, LINES)
        shapes = [child for child in row if child.tag in SHAPES]
        if len(shapes) != 1:
            raise _Broken(f"{name}: a <geometry> needs one of {', '.join(SHAPES)} (OpenDRIVE 1.8, {LINES})")
        _numbers(shapes[0], SHAPES[shapes[0].tag], name, LINES)
        if measured < 0:
            raise _Broken(f"{name}: a <geometry> has the length {measured:g} m (OpenDRIVE 1.8, {LINES})")
        if max(abs(x), abs(y)) > FARTHEST_M:
            raise _Broken(f"{name} begins more than {FARTHEST_M / 1000:g} km from the origin")
    kept = order_geometry(road)
    total = sum(float(row.attrib["length"]) for row in kept)
    if not length > 0 or abs(total - length) > LENGTH_M + LENGTH_SHARE * length:
        raise _Broken(f"{name} is {length:g} m long, and its geometry {total:g} m (OpenDRIVE 1.8, {LINES})")
    for piece, row in zip(list_pieces(kept), kept):
        if row.find("paramPoly3") is not None:
            with np.errstate(all="ignore"):  # numbers that overflow
                measured = piece.measure()
            if not abs(measured - piece.length) <= LENGTH_M + LENGTH_SHARE * piece.length:
                at = f"{name}: its <paramPoly3> at s = {piece.s:.6g} m"
                raise _Broken(f"{at} is {measured:.4g} m long, and says {piece.length:.4g} m (OpenDRIVE 1.8, {LINES})")
    for joint in measure_joints(kept):
        at = f"{name}: its geometry at s = {joint.s:.6g} m"
        if not joint.gap_m <= WIDEST_GAP_M:
            before = "where the one before it ends" if joint.s != float(kept[0].attrib["s"]) else "its beginning"
            most = f"in plan or along s, at most {WIDEST_GAP_M:g} m"
            raise _Broken(f"{at} begins {joint.gap_m:.3g} m from {before}, {most} (OpenDRIVE 1.8, {LINES})")
        if not joint.kink_rad <= SHARPEST_RAD:
            turn, most = math.degrees(joint.kink_rad), math.degrees(SHARPEST_RAD)
            raise _Broken(f"{at} turns by {turn:.0f}° at once, at most {most:.0f}° (OpenDRIVE 1.8, {LINES})")


def _check_lanes(road: ElementTree.Element, name: str) -> None:
    sections = road.findall("lanes/laneSection")
    if not sections:
        raise _Broken(f"{name} has no <laneSection> (OpenDRIVE 1.8, {LANES})")
    starts = [_numbers(section, ("s",), name, LANES)[0] for section in sections]
    if abs(min(starts)) > EARLIEST_M:
        raise _Broken(f"{name}: its lane sections begin at s = {min(starts):g} m, not at 0 (OpenDRIVE 1.8, {LANES})")
    for section in sections:
        for side, sign in (("left", 1), ("right", -1)):
            numbers = [_lane_number(lane, name) for lane in section.iterfind(f"{side}/lane")]
            if sorted(sign * number for number in numbers) != list(range(1, len(numbers) + 1)):
                raise _Broken(f"{name}: its {side} lanes are not numbered one by one (OpenDRIVE 1.8, {NUMBERS})")
        for lane in _side_lanes(section):
            for row in lane:
                if row.tag in ("width", "border"):
                    values = _numbers(row, ("sOffset", *"abcd"), name, WIDTHS)
                    if abs(values[1]) > WIDEST_M:
                        raise _Broken(f"{name}: a lane is {values[1]:g} m wide; supported: {WIDEST_M:g} m")


def _lane_number(lane: ElementTree.Element, name: str) -> int:
    try:
        return int(lane.get("id", ""))
    except ValueError:
        raise _Broken(
            f"{name}: the lane id {shorten(lane.get('id', ''))} is no integer (OpenDRIVE 1.8, {NUMBERS})"
        ) from None


def _side_lanes(section: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """Yield the lanes on the left and right of the centre lane."""
    for side in ("left", "right"):
        yield from section.iterfind(f"{side}/lane")


def _numbers(row: ElementTree.Element, names: tuple[str, ...], where: str, clause: str) -> list[float]:
    """Read attributes as finite numbers; raises `_Broken` for any other text."""
    out = []
    for name in names:
        text = row.get(name)
        try:
            value = float(text if text is not None else "")
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            said = "lacks" if text is None else "needs a number as"
            found = "" if text is None else f", not {shorten(text)}"
            raise _Broken(f"{where}: <{row.tag}> {said} '{name}'{found} (OpenDRIVE 1.8, {clause})")
        out.append(value)
    return out
