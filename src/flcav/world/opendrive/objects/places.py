"""Places, outlines and repetitions of the objects and signals of an OpenDRIVE map (OpenDRIVE 1.8, 13 and 14)."""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import shapely
from shapely.geometry import Polygon

from flcav.arrays import Array
from flcav.world.opendrive.road_surface import Road

Part = TypeVar("Part")

LARGEST_M = 200.0  # largest distance of an object's corner from its place, or from its road's reference line


def repeat_object(thing: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """Yield an object and its further copies: with every <repeat>, one per `distance` over `length`, from `s` on."""
    yield thing
    for row in thing.iterfind("repeat"):
        start, length, distance = (read_number(row, name) for name in ("s", "length", "distance"))
        count = int(length / distance) if distance > 0.5 and 0 < length < 1e4 else 0
        for i in range(1, count + 1):
            share = i * distance / length
            t = (1 - share) * read_number(row, "tStart") + share * read_number(row, "tEnd")
            one = ElementTree.Element("object", {**thing.attrib, "s": str(start + i * distance), "t": str(t)})
            one.extend(thing.iterfind("outline"))
            one.extend(thing.iterfind("outlines"))
            yield one


def outline_object(road: Road, thing: ElementTree.Element) -> Array | None:
    """Compute the outline (K, 2) [m] of an object in the map's frame, from its corners, or else from its extents.

    Corners are given in the object's frame (u, v), which its heading turns against the road, or on the road (s, t).
    None where the object has no place, or neither corners nor extents.
    """
    place = locate_thing(road, thing)
    if place is None:
        return None
    corners = [*thing.iter("cornerLocal")]
    if len(corners) > 2:
        local = np.array([(read_number(row, "u"), read_number(row, "v")) for row in corners])
    elif len(on_road := [*thing.iter("cornerRoad")]) > 2:
        s, t = (np.array([read_number(row, name) for row in on_road]) for name in ("s", "t"))
        return road.point(np.clip(s, 0.0, road.length), t)[:, :2] if np.abs(t).max() < LARGEST_M else None
    else:
        length, width = read_number(thing, "length") / 2, read_number(thing, "width") / 2
        local = np.array([(length, width), (-length, width), (-length, -width), (length, -width)])
    if not 0.0 < np.abs(local).max() < LARGEST_M:
        return None
    yaw = place[2] + read_number(thing, "hdg")
    cos, sin = np.cos(yaw), np.sin(yaw)
    return local @ np.array([[cos, sin], [-sin, cos]]) + place[:2]


@dataclass(frozen=True)
class TakenOver(Generic[Part]):
    """Parts of a town made of the objects of one kind in a map, and the objects left out."""

    found: tuple[Part, ...]  # parts of the town
    left: Counter[str]  # reason -> number of things that were left out
    taken: int | None = None  # number of things in the map that became `found`; None: the same as the parts

    def notes(self, what: str) -> list[str]:
        """Write the sentence of `note_taken` about these things; `what` is their name."""
        return note_taken(what, len(self.found) if self.taken is None else self.taken, self.left)


def note_taken(what: str, taken: int, left: Counter[str]) -> list[str]:
    """Write a sentence on how many things of a map were taken over and why others were not; empty without things."""
    if not taken and not left:
        return []
    reasons = "".join(f"; left out: {count} ({reason})" for reason, count in sorted(left.items()))
    return [f"{what} of the map taken over: {taken}{reasons}."]


def list_objects(
    root: ElementTree.Element, wanted: Callable[[ElementTree.Element], bool]
) -> Iterator[tuple[Road, ElementTree.Element]]:
    """Yield the objects of a map for which `wanted` is true, with their roads."""
    for row in root.iterfind("road"):
        things = [thing for thing in row.iterfind("objects/object") if wanted(thing)]
        if things:
            road = Road(row)
            yield from ((road, thing) for thing in things)


@dataclass(frozen=True)
class Rectangle:
    """A rectangle in the plane."""

    centre: Array  # (2,) x, y of the centre [m]
    edges: Array  # (2, 2) vectors along two neighbouring sides, one a row [m]
    sides: Array  # (2,) lengths of these sides [m]

    @property
    def extents(self) -> tuple[float, float, float]:
        """Return the longer and the shorter side [m], and the heading of the longer one [rad]."""
        long = int(np.argmax(self.sides))
        yaw = math.atan2(self.edges[long, 1], self.edges[long, 0])
        return float(self.sides[long]), float(self.sides[1 - long]), yaw


def enclose_outline(outline: Array) -> Rectangle | None:
    """Enclose an outline (K, 2) [m] in the smallest rectangle; None where it has no area."""
    rectangle = shapely.oriented_envelope(shapely.MultiPoint(outline))
    if not isinstance(rectangle, Polygon):
        return None
    corners = np.asarray(rectangle.exterior.coords)
    edges = np.diff(corners[:3], axis=0)
    return Rectangle(corners[:4].mean(axis=0), edges, np.hypot(*edges.T))


def locate_thing(
    road: Road, thing: ElementTree.Element, offset_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[float, float, float] | None:
    """Locate an object or signal of a road by its s and t: x, y [m], + `offset_m` [m], and the road's heading [rad].

    None where it has no valid place on the road.
    """
    s, t = read_number(thing, "s", math.nan), read_number(thing, "t", math.nan)
    if not (0 <= s <= road.length and abs(t) < 100):
        return None
    x, y, _ = road.point(np.array([s]), np.array([t]))[0].tolist()
    heading = float(road.line.at(np.array([s]))[0, 2])
    return x + offset_m[0], y + offset_m[1], heading


def read_number(row: ElementTree.Element, name: str, otherwise: float = 0.0) -> float:
    """Read an attribute as a finite number; `otherwise` where it is missing or none."""
    try:
        value = float(row.get(name, ""))
    except ValueError:
        return otherwise
    return value if math.isfinite(value) else otherwise
