"""The lane-level map of a town: vector layers (`map_layers`) and their bird's-eye raster (`rasterise`)."""

from collections.abc import Iterator, Sequence
from typing import get_args

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from flcav.world.map.imported import paint_spaces
from flcav.world.map.layers import Arrow, ArrowKind, Crossing, MapLane, MapLayers
from flcav.world.map.markings import generate_markings
from flcav.world.map.paint import ARROW_M, list_outlines, outline_arrow, outline_dashes, outline_stripes
from flcav.world.map.roads import Edge, Lane, RoadNet, read_net
from flcav.world.map.town import Town

Array = NDArray[np.float64]

RASTER_LAYERS: tuple[str, ...] = (
    "road",  # drivable surface
    "sidewalk",
    "lane",  # driving lanes on streets and inside junctions
    "marking",  # lines along the road
    "stop_line",  # stop lines and give-way lines
    "crossing",  # the whole area of a crossing
    "stripe",  # the painted stripes of a crossing
    "arrow",
)

WAYS: dict[str, ArrowKind] = {kind: kind for kind in get_args(ArrowKind)}
ARROWS_BEFORE_M = (8.0, 28.0)  # from the end of the lane back to an arrow's middle


def rasterise(
    layers: MapLayers, world_from_patch: Array, size_m: tuple[float, float], resolution_m: float
) -> NDArray[np.bool_]:
    """Return the bird's-eye raster (len(RASTER_LAYERS), H, W) of a patch: which pixel centres lie in each layer.

    `world_from_patch` (4, 4) is the pose of the patch's middle, x forward and y left; `size_m` its extents along x, y
    [m]; H = size_m[0] / resolution_m and W = size_m[1] / resolution_m, rounded.
    Row 0 is farthest ahead, column 0 farthest left: pixel (i, j) has its centre at x = size_m[0] / 2 - (i + 0.5)
    resolution_m, y = size_m[1] / 2 - (j + 0.5) resolution_m.
    """
    shape = round(size_m[0] / resolution_m), round(size_m[1] / resolution_m)
    patch_from_world = np.linalg.inv(world_from_patch)
    corner = np.array(size_m) / 2

    def layer(polygons: Sequence[Array]) -> NDArray[np.bool_]:
        if not polygons:
            return np.zeros(shape, np.bool_)
        counts = [len(polygon) for polygon in polygons]
        points = np.concatenate(polygons) @ patch_from_world[:2, :2].T + patch_from_world[:2, 3]
        return fill_polygons((corner - points) / resolution_m, np.array(counts), shape)

    return np.stack([layer(polygons) for polygons in _polygons(layers).values()])


def fill_polygons(points: Array, counts: NDArray[np.int64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the mask (H, W) of pixels whose centres (i + 0.5, j + 0.5) lie in any of the polygons.

    Scan-line fill by the nonzero winding rule, vectorised over all edges. `points` (N, 2) are the polygons' vertices as
    row and column [px], polygon after polygon; `counts` are their numbers of vertices. All polygons are wound the same
    way. `shape` is (H, W).
    """
    height, width = shape
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    local = np.arange(len(points)) - starts
    after = points[starts + (local + 1) % np.repeat(counts, counts)]
    low, high = np.minimum(points[:, 0], after[:, 0]), np.maximum(points[:, 0], after[:, 0])
    first = np.clip(np.ceil(low - 0.5), 0, height).astype(np.int64)
    last = np.clip(np.ceil(high - 0.5), 0, height).astype(np.int64)
    spans = last - first
    edge = np.repeat(np.arange(len(points)), spans)
    row = np.arange(len(edge)) - np.repeat(np.cumsum(spans) - spans, spans) + first[edge]
    a, b = points[edge], after[edge]
    column = a[:, 1] + (row + 0.5 - a[:, 0]) * (b[:, 1] - a[:, 1]) / (b[:, 0] - a[:, 0])
    column = np.clip(np.ceil(column - 0.5), 0, width).astype(np.int64)
    winding = np.zeros((height, width + 1), np.int32)
    np.add.at(winding, (row, column), np.where(b[:, 0] > a[:, 0], 1, -1))
    return np.cumsum(winding, axis=1)[:, :width] != 0


def _polygons(layers: MapLayers) -> dict[str, list[Array]]:
    """Return the polygons (K, 2) of each raster layer, world frame [m], in the order of `RASTER_LAYERS`."""
    across = ("stop_line", "yield_line")
    driving = [lane for lane in layers.lanes if lane.kind == "driving" and len(lane.centre_line) > 1]
    strips = shapely.buffer(
        np.array([LineString(lane.centre_line) for lane in driving]),
        np.array([lane.width_m / 2 for lane in driving]),
        cap_style="flat",
        join_style="mitre",
    )
    parts = {
        "road": layers.roads,
        "sidewalk": layers.sidewalks,
        "lane": list_outlines(strips),
        "marking": (piece for row in layers.markings if row.kind not in across for piece in outline_dashes(row)),
        "stop_line": (piece for row in layers.markings if row.kind in across for piece in outline_dashes(row)),
        "crossing": (row.outline for row in layers.crossings),
        "stripe": (piece for row in layers.crossings for piece in outline_stripes(row)),
        "arrow": (outline_arrow(row) for row in layers.arrows),
    }
    return {name: list(parts[name]) for name in RASTER_LAYERS}


def map_layers(town: Town) -> MapLayers:
    """Return the lane-level map of a town, in the world frame. The same town gives the same map."""
    net = read_net(town.net)
    roads = shapely.union_all([Polygon(outline) for outline in town.roads])
    crossings = tuple(_crossings(net, roads))
    crossed = shapely.union_all([Polygon(crossing.outline) for crossing in crossings])
    stop_lines = {line.lane: line.before_end_m for line in town.parameters.stop_lines}
    return MapLayers(
        roads=town.roads,
        sidewalks=town.sidewalks,
        lanes=tuple(_lanes(net)),
        markings=(*generate_markings(net, roads, crossed, stop_lines), *paint_spaces(town.parameters.parking)),
        crossings=crossings,
        arrows=tuple(_arrows(net)),
    )


def _lanes(net: RoadNet) -> Iterator[MapLane]:
    """Yield the lanes of a net with their successors; lanes inside junctions also with their turn and light."""
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
    """Yield the pedestrian crossings of a net, clipped to `roads`; of a divided one the largest part."""
    for edge in net.edges.values():
        if edge.function == "crossing":
            lane = edge.lanes[0]
            area = LineString(lane.shape).buffer(lane.width / 2, cap_style="flat", join_style="mitre")
            on_road = list(list_outlines(area.intersection(roads)))
            if on_road:
                largest = max(on_road, key=lambda outline: Polygon(outline).area)
                yield Crossing(edge.id, largest, lane.shape, lane.width)


def _arrows(net: RoadNet) -> Iterator[Arrow]:
    """Yield lane arrows before traffic lights, and on streets whose lanes lead in different directions."""
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
    """Return the kind of arrow that shows SUMO's `turns` (s, l, r, ...); None where it shows none of them."""
    names = [name for letter, name in (("s", "straight"), ("l", "left"), ("r", "right")) if letter in turns]
    return WAYS.get("_".join(names))


def _along(edge: Edge, lane: Lane, way: ArrowKind) -> Iterator[Arrow]:
    """Yield the arrows of one lane, `ARROWS_BEFORE_M` before its end, as far as the lane is long enough."""
    line = LineString(lane.shape)
    for before in ARROWS_BEFORE_M:
        middle = line.length - before
        if middle < ARROW_M:
            return
        a, b = (line.interpolate(middle + side * ARROW_M / 2) for side in (-1, 1))
        at = line.interpolate(middle)
        yield Arrow(way, at.x, at.y, float(np.arctan2(b.y - a.y, b.x - a.x)), lane.id)
