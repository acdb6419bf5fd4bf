"""Buildings, trees, hedges, walls, railings and parking spaces of an OpenDRIVE map (OpenDRIVE 1.8, 13)."""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
from typing import Literal

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from flcav.arrays import Array
from flcav.world.map.parameters import CLUTTER, ObjectParameters, ParkingParameters
from flcav.world.map.roads import LaneKind, RoadNet
from flcav.world.map.street_furniture import outline_space
from flcav.world.map.surfaces import make_footprint
from flcav.world.opendrive.objects.places import (
    LARGEST_M,
    Rectangle,
    TakenOver,
    enclose_outline,
    list_objects,
    locate_thing,
    outline_object,
    read_number,
    repeat_object,
)
from flcav.world.opendrive.road_surface import Road

Kind = Literal["building", "tree", "hedge", "wall", "fence", "railing", "cabinet"]

KINDS: dict[str, Kind] = {  # type of an object in the map -> kind in the town; an obstacle is a box like a cabinet
    "building": "building",
    "tree": "tree",
    "vegetation": "hedge",
    "barrier": "wall",
    "soundBarrier": "wall",
    "railing": "railing",
    "obstacle": "cabinet",
}
SIDE_M, HEIGHT_M = (0.02, 200.0), (0.2, 150.0)  # least and largest side and height that are believed
TREE_M = 2.0  # least height of an object with a radius that is a tree
PIECE_M = 4.0  # largest length of the straight pieces of an object that continues along a road
LONGEST_M = 20_000.0  # largest length over which an object continues along a road
TOUCHED = 0.1  # largest share of a footprint that may lie on a lane


def find_standing_objects(
    root: ElementTree.Element, offset_m: tuple[float, float], net: RoadNet
) -> TakenOver[ObjectParameters]:
    """Find the objects of `KINDS` in the map below `root` that stand on no lane or sidewalk of `net`.

    A place in the town is that in the map + `offset_m` (x, y) [m].
    """
    ways = cover_lanes(net, ("driving", "bicycle", "sidewalk", "walkingarea", "crossing"))
    shapely.prepare(ways)
    found: list[ObjectParameters] = []
    taken = 0
    left = Counter[str]()
    for road, thing in list_objects(root, lambda thing: thing.get("type") in KINDS):
        for pieces in _list_copies(road, thing, np.array(offset_m)):
            free = [piece for piece in pieces if not _stands_on(piece, ways)]
            found += free
            taken += bool(free)
            if not free:
                left["on a lane or sidewalk" if pieces else "no place or size"] += 1
    return TakenOver(tuple(found), left, taken)


def _stands_on(piece: ObjectParameters, ways: shapely.Geometry) -> bool:
    """Return whether more than `TOUCHED` of a footprint is on the area `ways`; of a tree only the trunk counts."""
    if piece.kind == "tree":
        return bool(shapely.intersects(ways, shapely.Point(piece.x, piece.y)))
    shape = make_footprint(piece.x, piece.y, math.radians(piece.yaw_deg), piece.length_m, piece.width_m)
    return bool(shapely.area(shapely.intersection(shape, ways)) > TOUCHED * shape.area)


def _list_copies(road: Road, thing: ElementTree.Element, offset_m: Array) -> Iterator[list[ObjectParameters]]:
    """Yield an object and its repetitions, as the pieces of each; an empty list without a place or a size."""
    kind = KINDS[thing.get("type", "")]
    if kind == "wall" and "fence" in thing.get("name", "").lower():
        kind = "fence"
    along = [row for row in thing.iterfind("repeat") if read_number(row, "distance") == 0]
    for row in along:
        yield [*_go_along(road, thing, row, kind, offset_m)]
    for one in [] if along else repeat_object(thing):
        yield [*_stand(road, one, kind, offset_m)]


def _go_along(
    road: Road, thing: ElementTree.Element, row: ElementTree.Element, kind: Kind, offset_m: Array
) -> Iterator[ObjectParameters]:
    """Yield the pieces of an object that continues along a road; the <repeat> `row` gives its size and place by s."""
    start = min(max(read_number(row, "s"), 0.0), road.length)
    length = min(read_number(row, "length"), road.length - start, LONGEST_M)
    if length <= 0:
        return
    share = np.linspace(0.0, 1.0, max(1, math.ceil(length / PIECE_M)) + 1)

    def spread(name: str, otherwise: float) -> Array:
        first = read_number(row, f"{name}Start", otherwise)
        return first + share * (read_number(row, f"{name}End", first) - first)

    t = spread("t", read_number(thing, "t"))
    width = spread("width", read_number(thing, "width") or CLUTTER.get(kind, (0.0, 0.5, 0.0))[1])
    top = spread("zOffset", read_number(thing, "zOffset")) + spread("height", read_number(thing, "height"))
    if np.abs(t).max() > LARGEST_M:
        return
    points = road.point(start + share * length, t)[:, :2] + offset_m
    for i in range(len(points) - 1):
        step = points[i + 1] - points[i]
        middle = (points[i] + points[i + 1]) / 2
        sides = float(np.hypot(*step)), float(width[i : i + 2].mean())
        yield from _describe(kind, middle, math.atan2(step[1], step[0]), sides, float(top[i : i + 2].mean()))


def _stand(road: Road, thing: ElementTree.Element, kind: Kind, offset_m: Array) -> Iterator[ObjectParameters]:
    """Yield an object at a single place; nothing without a place or a size."""
    place = locate_thing(road, thing)
    if place is None:
        return
    heights = [read_number(corner, "height") for tag in ("cornerLocal", "cornerRoad") for corner in thing.iter(tag)]
    top = read_number(thing, "zOffset") + (read_number(thing, "height") or max(heights, default=0.0))
    radius = read_number(thing, "radius")
    if radius > 0 and kind in ("tree", "hedge") and top >= TREE_M:
        kind = "tree"
    outline = outline_object(road, thing)
    found: Rectangle | None = None if outline is None else enclose_outline(outline + offset_m)
    if radius > 0:
        yield from _describe(kind, place[:2] + offset_m, place[2], (2 * radius, 2 * radius), top)
    elif found is not None:
        length, width, yaw = found.extents
        yield from _describe(kind, found.centre, yaw, (length, width), top)


def _describe(
    kind: Kind, centre: Array, yaw: float, sides: tuple[float, float], height: float
) -> Iterator[ObjectParameters]:
    """Yield an object at `centre` (2,) [m] of heading `yaw` [rad] and these extents [m]; nothing if not believed."""
    if SIDE_M[0] <= min(sides) and max(sides) <= SIDE_M[1] and HEIGHT_M[0] <= height <= HEIGHT_M[1]:
        yield ObjectParameters(
            kind=kind,
            x=round(float(centre[0]), 3),
            y=round(float(centre[1]), 3),
            yaw_deg=round(math.degrees(yaw) % 360.0, 2),
            length_m=round(sides[0], 2),
            width_m=round(sides[1], 2),
            height_m=round(height, 2),
        )


LENGTH_M, WIDTH_M = (3.0, 20.0), (1.7, 6.0)  # least and largest extents of a parking space that are believed


def find_parking(
    root: ElementTree.Element, offset_m: tuple[float, float], net: RoadNet
) -> TakenOver[ParkingParameters]:
    """Find the parking spaces of the map below `root` that are clear of the lanes of `net` and of one another.

    A place in the town is that in the map + `offset_m` (x, y) [m].
    """
    found: list[ParkingParameters] = []
    left = Counter[str]()
    driven, walked = cover_lanes(net, ("driving", "bicycle")), cover_lanes(net, ("sidewalk", "walkingarea", "crossing"))
    taken: list[Polygon] = []
    for road, original in list_objects(root, lambda thing: thing.get("type") == "parkingSpace"):
        for thing in repeat_object(original):
            outline = outline_object(road, thing)
            space = None if outline is None else _enclose(outline + offset_m)
            if space is None:
                left["no place or size of a parking space"] += 1
                continue
            shape = outline_space(space)
            if shape.intersection(driven).area > TOUCHED * shape.area:
                left["on a lane for vehicles"] += 1
            elif shape.intersection(walked).area > TOUCHED * shape.area:
                left["on a sidewalk"] += 1
            elif any(shape.intersection(other).area > TOUCHED * shape.area for other in taken):
                left["on another one"] += 1
            else:
                found.append(space)
                taken.append(shape)
    return TakenOver(tuple(found), left)


def cover_lanes(net: RoadNet, kinds: tuple[LaneKind, ...]) -> BaseGeometry:
    """Unite the areas of all lanes of these kinds, in the town's frame [m]."""
    lanes = [lane for edge in net.edges.values() for lane in edge.lanes if lane.kind in kinds and len(lane.shape) > 1]
    areas = [
        shapely.make_valid(Polygon(lane.shape))
        if lane.kind == "walkingarea" and len(lane.shape) > 2
        else LineString(lane.shape).buffer(lane.width / 2, cap_style="flat", join_style="mitre")
        for lane in lanes
    ]
    return shapely.union_all(areas)


def _enclose(outline: np.ndarray) -> ParkingParameters | None:
    """Enclose an outline (K, 2) [m] in the smallest rectangle, as a space; None if that has no extents of a space."""
    rectangle = enclose_outline(outline)
    if rectangle is None:
        return None
    length, width, yaw = rectangle.extents
    if not (LENGTH_M[0] <= length <= LENGTH_M[1] and WIDTH_M[0] <= width <= WIDTH_M[1]):
        return None
    x, y = rectangle.centre.tolist()
    turned = round(math.degrees(yaw) % 360.0, 2)
    return ParkingParameters(
        x=round(x, 3), y=round(y, 3), yaw_deg=turned, length_m=round(length, 2), width_m=round(width, 2)
    )
