"""The lane-level map of a town, as vector layers (`map_layers`) and as bird's-eye rasters (`rasterise`)."""

from collections.abc import Iterator
from typing import get_args

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from flcav.world.layers import Arrow, ArrowKind, Crossing, MapLane, MapLayers
from flcav.world.markings import markings
from flcav.world.paint import ARROW_M, outlines
from flcav.world.raster import RASTER_LAYERS, rasterise
from flcav.world.roads import Edge, Lane, RoadNet, read_net
from flcav.world.town import Town

__all__ = ["RASTER_LAYERS", "map_layers", "rasterise"]

Array = NDArray[np.float64]

WAYS: dict[str, ArrowKind] = {kind: kind for kind in get_args(ArrowKind)}
ARROWS_BEFORE_M = (8.0, 28.0)  # from the stop line to an arrow's middle


def map_layers(town: Town) -> MapLayers:
    """Return the map of a town. The same town gives the same map."""
    net = read_net(town.net)
    roads = shapely.union_all([Polygon(outline) for outline in town.roads])
    crossings = tuple(_crossings(net, roads))
    crossed = shapely.union_all([Polygon(crossing.outline) for crossing in crossings])
    return MapLayers(
        roads=town.roads,
        sidewalks=town.sidewalks,
        lanes=tuple(_lanes(net)),
        markings=tuple(markings(net, roads, crossed)),
        crossings=crossings,
        arrows=tuple(_arrows(net)),
    )


def _lanes(net: RoadNet) -> Iterator[MapLane]:
    following: dict[str, list[str]] = {}
    entered = {connection.via: connection for connection in net.connections if connection.via}
    for connection in net.connections:
        following.setdefault(connection.start, []).append(connection.via or connection.end)
    for edge in net.edges.values():
        for lane in edge.lanes:
            entry = entered.get(lane.id)
            yield MapLane(
                id=lane.id,
                kind=lane.kind,
                centre_line=lane.shape,
                width_m=lane.width,
                speed=lane.speed,
                junction="" if edge.function == "normal" else edge.id[1:].rpartition("_")[0],
                turn=entry.turn.lower() if entry else "",
                light=entry.light if entry else "",
                successors=tuple(dict.fromkeys(following.get(lane.id, []))),
            )


def _crossings(net: RoadNet, roads: BaseGeometry) -> Iterator[Crossing]:
    for edge in net.edges.values():
        if edge.function == "crossing":
            lane = edge.lanes[0]
            area = LineString(lane.shape).buffer(lane.width / 2, cap_style="flat", join_style="mitre")
            on_road = list(outlines(area.intersection(roads)))
            if on_road:
                largest = max(on_road, key=lambda outline: Polygon(outline).area)
                yield Crossing(edge.id, largest, lane.shape, lane.width)


def _arrows(net: RoadNet) -> Iterator[Arrow]:
    """Yield arrows on the lanes into junctions with lights, and wherever the lanes of a street go different ways."""
    turns: dict[str, set[str]] = {}
    for connection in net.connections:
        turns.setdefault(connection.start, set()).add(connection.turn.lower())
    for edge in net.streets:
        driving = edge.lanes_of("driving")
        ways: list[ArrowKind | None] = [_way(turns.get(lane.id, set())) for lane in driving]
        if not net.junctions[edge.end].kind.startswith("traffic_light") and len(set(ways)) < 2:
            continue
        for lane, way in zip(driving, ways):
            if way is not None:
                yield from _along(edge, lane, way)


def _way(turns: set[str]) -> ArrowKind | None:
    names = [name for letter, name in (("s", "straight"), ("l", "left"), ("r", "right")) if letter in turns]
    return WAYS.get("_".join(names))


def _along(edge: Edge, lane: Lane, way: ArrowKind) -> Iterator[Arrow]:
    line = LineString(lane.shape)
    for before in ARROWS_BEFORE_M:
        middle = line.length - before
        if middle < ARROW_M:
            return
        a, b = (line.interpolate(middle + side * ARROW_M / 2) for side in (-1, 1))
        at = line.interpolate(middle)
        yield Arrow(way, at.x, at.y, float(np.arctan2(b.y - a.y, b.x - a.x)), lane.id)
