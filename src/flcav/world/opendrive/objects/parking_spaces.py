"""Parking spaces of an OpenDRIVE map: objects with an outline, or a length and a width (OpenDRIVE 1.8, 13)."""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from flcav.world.map.imported import outline_space
from flcav.world.map.parameters import ParkingParameters
from flcav.world.map.roads import LaneKind, RoadNet
from flcav.world.opendrive.objects.places import enclose_outline, outline_object, repeat_object
from flcav.world.opendrive.road_surface import Road

LENGTH_M, WIDTH_M = (3.0, 20.0), (1.7, 6.0)  # extents that are believed
TOUCHED = 0.1  # share of a space that may lie on a lane or another space


@dataclass(frozen=True)
class ParkingSpaces:
    """The parking spaces that a map describes, and how many were left out, by the reason."""

    found: tuple[ParkingParameters, ...]
    left: Counter[str]


def find_parking(root: ElementTree.Element, offset_m: tuple[float, float], net: RoadNet) -> ParkingSpaces:
    """Return the parking spaces of a map beside the lanes of `net`, in town coordinates: map + `offset_m` [m]."""
    found: list[ParkingParameters] = []
    left = Counter[str]()
    driven, walked = cover_lanes(net, ("driving", "bicycle")), cover_lanes(net, ("sidewalk", "walkingarea", "crossing"))
    taken: list[Polygon] = []
    for row in root.iterfind("road"):
        things = [thing for thing in row.iterfind("objects/object") if thing.get("type") == "parkingSpace"]
        road = Road(row) if things else None
        for thing in [one for each in things for one in repeat_object(each)]:
            outline = None if road is None else outline_object(road, thing)
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
    return ParkingSpaces(tuple(found), left)


def cover_lanes(net: RoadNet, kinds: tuple[LaneKind, ...]) -> BaseGeometry:
    """Return the area of all lanes of these kinds [m]."""
    lanes = [lane for edge in net.edges.values() for lane in edge.lanes if lane.kind in kinds and len(lane.shape) > 1]
    areas = [
        shapely.make_valid(Polygon(lane.shape))
        if lane.kind == "walkingarea" and len(lane.shape) > 2
        else LineString(lane.shape).buffer(lane.width / 2, cap_style="flat", join_style="mitre")
        for lane in lanes
    ]
    return shapely.union_all(areas)


def _enclose(outline: np.ndarray) -> ParkingParameters | None:
    """Return the smallest rectangle around an outline (K, 2) as a space; None where it is none for a vehicle."""
    found = enclose_outline(outline)
    if found is None:
        return None
    long = int(np.argmax(found.sides))
    length, width = found.sides[[long, 1 - long]].tolist()
    if not (LENGTH_M[0] <= length <= LENGTH_M[1] and WIDTH_M[0] <= width <= WIDTH_M[1]):
        return None
    x, y = found.centre.tolist()
    yaw = math.degrees(math.atan2(found.edges[long, 1], found.edges[long, 0])) % 360.0
    return ParkingParameters(
        x=round(x, 3), y=round(y, 3), yaw_deg=round(yaw, 2), length_m=round(length, 2), width_m=round(width, 2)
    )
