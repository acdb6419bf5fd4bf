"""Parameters of an imported town: objects of its map, defaults by street type, traffic and sensor sites."""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from shapely.geometry import LineString

from flcav.world.map.parameters import (
    GeoReference,
    MapSource,
    ObjectParameters,
    ParkingParameters,
    PoleParameters,
    PostParameters,
    SignalParameters,
    SignParameters,
    StopLineParameters,
    StreetParameters,
    TownParameters,
)
from flcav.world.map.roads import Edge, RoadNet
from flcav.world.opendrive.objects.signal_heads import count_controllers, find_heads
from flcav.world.opendrive.objects.signs import find_map_poles, find_signs
from flcav.world.opendrive.objects.standing import find_parking, find_standing_objects
from flcav.world.opendrive.objects.stop_lines import add_crossing_lines, find_stop_lines, stop_at_lines


@dataclass(frozen=True)
class MapObjects:
    """The objects and signals of a map, in the town's frame, and notes on their numbers."""

    signs: tuple[SignParameters, ...]
    limits: bool  # whether the map has speed-limit signs, among `signs` or left out
    posts: tuple[PostParameters, ...]
    objects: tuple[ObjectParameters, ...]
    signals: tuple[SignalParameters, ...]
    stop_lines: tuple[StopLineParameters, ...]
    parking: tuple[ParkingParameters, ...]
    notes: tuple[str, ...]  # one sentence a kind of object


def take_objects(
    root: ElementTree.Element, offset_m: tuple[float, float], net: RoadNet, path: Path, *, crosswalks: bool
) -> MapObjects:
    """Collect the objects and signals of the map below `root`; write where vehicles stop into the net file `path`.

    A place in the town is that in the map + `offset_m` (x, y) [m]. `net` is the content of `path`; `crosswalks` says
    whether its crossings are the map's, so that stop lines are added before them.
    """
    heads = find_heads(root, offset_m, net)
    parking = find_parking(root, offset_m, net)
    objects = find_standing_objects(root, offset_m, net)
    signs, posts = find_signs(root, offset_m), find_map_poles(root, offset_m)
    marked = find_stop_lines(root, offset_m, net)
    lines = add_crossing_lines(net, marked.found) if crosswalks else marked.found
    stop_at_lines(path, lines)
    several, alike = count_controllers(heads.found, path)
    switched = f"Controllers with several of these heads: {several}; switched alike here: {alike}."
    return MapObjects(
        signs=signs.found,
        limits=signs.limits,
        posts=posts.found,
        objects=objects.found,
        signals=heads.found,
        stop_lines=lines,
        parking=parking.found,
        notes=(
            *signs.notes("Signs"),
            *posts.notes("Poles"),
            *heads.notes("Signal heads"),
            *marked.notes("Stop lines"),
            *parking.notes("Parking spaces"),
            *objects.notes("Buildings, plants, barriers and obstacles"),
            *([switched] if several else []),
        ),
    )


VEHICLES_PER_KM = 9.0  # vehicles per km of driving lane
PEDESTRIANS_PER_KM = 10.0  # pedestrians per km of sidewalk
MOST = 150  # largest number of vehicles, and of pedestrians
CORNER_M = 4.0  # distance of a pole at a junction from the end of its edge
STRAIGHT_M = 60.0  # least length of a straight edge with a pole midway
BENT_M = 2.0  # largest deviation of a straight edge from its chord
STREETS: dict[str, StreetParameters] = {
    "arterial": StreetParameters(
        frontage_m=1.0,
        setback_m=(0.5, 3.0),
        building_length_m=(12.0, 22.0),
        building_depth_m=(10.0, 13.0),
        building_height_m=(9.0, 18.0),
        building_gap_m=(0.5, 4.0),
        tree_spacing_m=24.0,
        clutter_spacing_m=16.0,
        clutter={"kiosk": 0.6, "shelter": 1.0, "bins": 1.0, "planter": 1.0, "cabinet": 0.8},
        parked=0.3,
        parked_mix={"car": 0.8, "van": 0.2},
        traffic=1.5,
        footfall=2.0,
    ),
    "street": StreetParameters(
        setback_m=(1.5, 4.5),
        building_height_m=(5.0, 10.0),
        building_gap_m=(1.5, 6.0),
        tree_spacing_m=16.0,
        clutter_spacing_m=15.0,
        clutter={"hedge": 2.0, "bins": 1.0, "cabinet": 0.4},
        parked=0.3,
        parked_mix={"car": 0.9, "van": 0.1},
    ),
    "open": StreetParameters(footfall=0.0),
}
MIX = {"car": 0.66, "van": 0.12, "truck": 0.05, "bus": 0.03, "motorcycle": 0.05, "bicycle": 0.09}


def furnish(
    net: RoadNet, *, description: str, seed: int, geo: GeoReference, source: MapSource, found: MapObjects
) -> TownParameters:
    """Set the parameters of a town on `net` with the objects `found` in its map.

    Raises `KeyError` for a street type that is not in `STREETS`.
    """
    kinds = sorted({edge.type for edge in net.streets})
    return TownParameters(
        description=description,
        seed=seed,
        geo=geo,
        source=source,
        vehicles=_count(net, "driving", VEHICLES_PER_KM),
        pedestrians=_count(net, "sidewalk", PEDESTRIANS_PER_KM),
        mix=MIX,
        streets={kind: STREETS[kind] for kind in kinds},
        poles=tuple(find_candidate_poles(net)),
        signs=found.signs,
        limits_known=found.limits,
        posts=found.posts,
        objects=found.objects,
        signals=found.signals,
        stop_lines=found.stop_lines,
        parking=found.parking,
    )


def find_candidate_poles(net: RoadNet) -> list[PoleParameters]:
    """List candidate sites of roadside sensors, numbered from north to south, then from west to east.

    Every junction of three or more streets has one, on the widest street that leads there, and every straight edge of
    at least `STRAIGHT_M` has one midway. Edges without a sidewalk have none.
    """
    into: dict[str, list[Edge]] = {}
    for edge in net.streets:
        if edge.lanes_of("sidewalk") and edge.lanes_of("driving") and _length(edge) > 2 * CORNER_M:
            into.setdefault(edge.end, []).append(edge)
    arms = {name: {edge.start for edge in net.streets if edge.end == name} for name in net.junctions}
    sites: list[tuple[Edge, Literal["straight", "cross", "tee", "roundabout"], float]] = []
    done: set[frozenset[str]] = set()
    for name, edges in into.items():
        if len(arms[name] | {edge.end for edge in net.streets if edge.start == name}) > 2:
            widest = max(edges, key=lambda edge: (len(edge.lanes_of("driving")), _length(edge), edge.id))
            kind = "roundabout" if name in net.roundabouts else "cross" if len(arms[name]) > 3 else "tee"
            sites.append((widest, kind, CORNER_M))
        for edge in sorted(edges, key=lambda edge: edge.id):
            street = frozenset((edge.start, edge.end))
            if street not in done and _length(edge) >= STRAIGHT_M and _bend(edge) <= BENT_M:
                done.add(street)
                sites.append((edge, "straight", round(_length(edge) / 2, 1)))

    def place(site: tuple[Edge, str, float]) -> tuple[float, float]:
        line = LineString(site[0].lanes_of("sidewalk")[-1].shape)
        at = line.interpolate(line.length - site[2])
        return -round(at.y), round(at.x)

    return [
        PoleParameters(id=i + 1, kind=kind, edge=edge.id, before_end_m=before)
        for i, (edge, kind, before) in enumerate(sorted(sites, key=place))
    ]


def _count(net: RoadNet, kind: str, per_km: float) -> int:
    """Compute the number of road users, at most `MOST`, from the total length of the lanes of a kind."""
    metres = sum(LineString(lane.shape).length for edge in net.streets for lane in edge.lanes_of(kind))
    return min(round(per_km * metres / 1000), MOST)


def _length(edge: Edge) -> float:
    return LineString(edge.lanes[0].shape).length


def _bend(edge: Edge) -> float:
    """Compute the largest distance of an edge's outermost lane from its chord [m]."""
    line = edge.lanes[0].shape
    chord = LineString(line[[0, -1]])
    return float(np.max(shapely.distance(shapely.points(line), chord)))
