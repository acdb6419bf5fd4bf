"""The lane-level map of a town: vector layers (`map_layers`), road markings, and a bird's-eye raster (`rasterise`).

Road markings of a SUMO net follow the practice of European towns. Lane lines are dashed, and solid before a controlled
junction. The directions of a street are separated by a dashed line, or by a double solid line if they have more than
two driving lanes together. Solid lines separate bicycle and parking lanes; edge lines mark streets without a kerb and
fast ones. Approaches end in a stop line or a give-way line.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import get_args

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import substring

from flcav.arrays import Array, Ints, Mask
from flcav.world.map.layers import (
    ARROW_M,
    Arrow,
    ArrowKind,
    Crossing,
    MapLane,
    MapLayers,
    Marking,
    MarkingKind,
    list_outlines,
    outline_arrow,
    outline_dashes,
    outline_stripes,
)
from flcav.world.map.roads import CARRIAGEWAY, Edge, Lane, RoadNet, read_net
from flcav.world.map.street_furniture import paint_spaces
from flcav.world.map.town import Town

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
ARROWS_BEFORE_M = (8.0, 28.0)  # distances of arrows' centres from the end of the lane


def rasterise(layers: MapLayers, world_from_patch: Array, size_m: tuple[float, float], resolution_m: float) -> Mask:
    """Rasterise a patch in bird's-eye view: (len(RASTER_LAYERS), H, W) whether pixel centres are in the layers.

    `world_from_patch` (4, 4) [m] is the pose of the patch's centre, x forward and y left; `size_m` its extents along
    x, y [m]; H = size_m[0] / resolution_m and W = size_m[1] / resolution_m, rounded, with `resolution_m` [m/px]. Row 0
    is farthest ahead, column 0 farthest left: the centre of pixel (i, j) is at x = size_m[0] / 2 - (i + 0.5)
    resolution_m, y = size_m[1] / 2 - (j + 0.5) resolution_m.
    """
    shape = round(size_m[0] / resolution_m), round(size_m[1] / resolution_m)
    patch_from_world = np.linalg.inv(world_from_patch)
    corner = np.array(size_m) / 2

    def layer(polygons: Sequence[Array]) -> Mask:
        if not polygons:
            return np.zeros(shape, np.bool_)
        counts = [len(polygon) for polygon in polygons]
        points = np.concatenate(polygons) @ patch_from_world[:2, :2].T + patch_from_world[:2, 3]
        return fill_polygons((corner - points) / resolution_m, np.array(counts), shape)

    return np.stack([layer(polygons) for polygons in _polygons(layers).values()])


def fill_polygons(points: Array, counts: Ints, shape: tuple[int, int]) -> Mask:
    """Fill polygons: return the mask (H, W) of pixels whose centres (i + 0.5, j + 0.5) are in one of them.

    Scan-line fill by the nonzero winding rule, vectorised over all edges. `points` (N, 2) are the polygons' vertices as
    row and column [px], polygon by polygon; `counts` are the polygons' numbers of vertices. All polygons have the same
    orientation. `shape` is (H, W).
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
    """Return the polygons (K, 2) of the raster layers, world frame [m], in the order of `RASTER_LAYERS`."""
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
    """Build the lane-level map of a town, world frame [m]. The same town gives the same map."""
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
    """Yield the lanes of a net with their successors; lanes inside junctions also have their turn and light."""
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
    """Yield the pedestrian crossings of a net, clipped to `roads`; only the largest part of a divided one."""
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
    """Yield the arrows of a lane, `ARROWS_BEFORE_M` before its end, where the lane is long enough."""
    line = LineString(lane.shape)
    for before in ARROWS_BEFORE_M:
        middle = line.length - before
        if middle < ARROW_M:
            return
        a, b = (line.interpolate(middle + side * ARROW_M / 2) for side in (-1, 1))
        at = line.interpolate(middle)
        yield Arrow(way, at.x, at.y, float(np.arctan2(b.y - a.y, b.x - a.x)), lane.id)


LINE_M = 0.12  # width of a line
BICYCLE_LINE_M = 0.25  # width of the line along a bicycle lane
DASH_M, GAP_M = 3.0, 6.0  # of a dashed lane line
YIELD_DASH_M, YIELD_GAP_M, YIELD_LINE_M = 0.5, 0.25, 0.5  # dash, gap and width of a give-way line
STOP_LINE_M = 0.5  # width of a stop line
TO_STOP_M = 0.35  # distance from the middle of a stop line to the end of its lane
APPROACH_M = 18.0  # length over which lane lines are solid before a controlled junction
DOUBLE_M = 0.12  # distance of the lines of a double line from the middle of the road
INSET_M = 0.2  # distance of an edge line from the edge of the lane
FAST = 13.0  # speed limit from which streets have edge lines even along a kerb [m/s]
SHORTEST_M = 0.3  # shorter pieces of a line are left out
SAME_LINE_M = 0.7  # distance within which the left sides of two edges coincide: the directions of one street


def generate_markings(
    net: RoadNet, roads: BaseGeometry, crossings: BaseGeometry, stop_lines: Mapping[str, float]
) -> Iterator[Marking]:
    """Yield the road markings of a net, clipped to `roads` and left out on `crossings`.

    Both areas are shapely geometry in the world frame [m]. `stop_lines` maps lanes to the distances of their stop lines
    from their ends [m]; edges with such a lane have no other stop line.
    """
    paper = roads.buffer(-0.01).difference(crossings)
    shapely.prepare(paper)
    for marking in _generate_unclipped(net, stop_lines):
        width = marking.width_m / 2
        inside = paper.buffer(-width) if width > LINE_M else paper  # wide ones are completely on the road
        for part in _lines(LineString(marking.line).intersection(inside)):
            if part.length >= SHORTEST_M:
                line = np.asarray(part.coords)
                yield Marking(marking.kind, line, marking.width_m, marking.dash_m, marking.gap_m, marking.colour)


def _generate_unclipped(net: RoadNet, stop_lines: Mapping[str, float]) -> Iterator[Marking]:
    """Yield the unclipped markings of a net, edge by edge."""
    bends = _bends(net)
    facing: dict[tuple[str, str], list[Edge]] = {}
    for edge in net.edges.values():
        if edge.function == "normal":
            facing.setdefault((edge.start, edge.end), []).append(edge)
        elif edge.id in bends:
            facing.setdefault(("", bends[edge.id]), []).append(edge)
    for edge in net.edges.values():
        inside = edge.id in bends
        if edge.function != "normal" and not inside:
            continue
        lanes = [lane for lane in edge.lanes if lane.kind in CARRIAGEWAY and len(lane.shape) > 1]
        if not lanes:
            continue
        approach = APPROACH_M if not inside and _is_controlled(net, edge) else 0.0
        yield from _between_lanes(lanes, approach, net.side)
        across = facing.get(("", bends[edge.id]) if inside else (edge.end, edge.start), [])
        yield from _left_side(edge, lanes, across, approach, net.side)
        kerb = any(lane.kind == "sidewalk" for lane in edge.lanes) and lanes[0].speed < FAST
        if not kerb and not inside and lanes[0].kind == "driving":
            yield Marking("edge", _beside(lanes[0], INSET_M - lanes[0].width / 2, net.side), LINE_M, 0.0, 0.0)
        if not inside:
            known = [lane for lane in edge.lanes if lane.id in stop_lines]
            yield from (_stop_line(lane, stop_lines[lane.id], net.side) for lane in known)
            if not known:
                yield from _entry(net, edge)


def _between_lanes(lanes: list[Lane], approach: float, side: int) -> Iterator[Marking]:
    """Yield the lines between neighbouring lanes, from the kerb to the middle; `approach` is as in `_broken`."""
    for right, left in pairwise(lanes):
        line = _beside(right, right.width / 2, side)
        if right.kind == left.kind == "driving":
            yield from _broken(line, approach)
        else:
            wide = {right.kind, left.kind} == {"bicycle", "driving"}
            yield Marking("solid", line, BICYCLE_LINE_M if wide else LINE_M, 0.0, 0.0)


def _left_side(edge: Edge, lanes: list[Lane], across: list[Edge], approach: float, side: int) -> Iterator[Marking]:
    """Yield the centre line towards the adjacent edge of `across` (the opposite direction), or else an edge line."""
    line = _beside(lanes[-1], lanes[-1].width / 2, side)
    for other in across:
        theirs = [lane for lane in other.lanes if lane.kind in CARRIAGEWAY and len(lane.shape) > 1]
        if other is edge or not theirs or not _coincide(line, _beside(theirs[-1], theirs[-1].width / 2, side)):
            continue
        if edge.id > other.id:
            return  # the other direction has it
        if len([lane for lane in (*lanes, *theirs) if lane.kind == "driving"]) > 2:
            for aside in (-DOUBLE_M, DOUBLE_M):
                yield Marking("solid", _beside(lanes[-1], lanes[-1].width / 2 + aside, side), LINE_M, 0.0, 0.0)
        else:
            yield from _broken(line, approach, both_ends=True)
        return
    if edge.function == "normal":
        yield Marking("edge", _beside(lanes[-1], lanes[-1].width / 2 - INSET_M, side), LINE_M, 0.0, 0.0)


def _broken(line: Array, approach: float, *, both_ends: bool = False) -> Iterator[Marking]:
    """Yield a dashed line that is solid over its last `approach` [m], or over both ends, by a third of it at most."""
    whole = LineString(line)
    approach = min(approach, whole.length / 3)
    start = approach if both_ends else 0.0
    pieces: list[tuple[MarkingKind, float, float]] = [("dashed", start, whole.length - approach)]
    pieces.append(("solid", 0.0, start))
    pieces.append(("solid", whole.length - approach, whole.length))
    for kind, low, high in pieces:
        if high - low > SHORTEST_M:
            dash, gap = (DASH_M, GAP_M) if kind == "dashed" else (0.0, 0.0)
            yield Marking(kind, np.asarray(substring(whole, low, high).coords), LINE_M, dash, gap)


def _stop_line(lane: Lane, before_end_m: float, side: int) -> Marking:
    """Return the stop line across a lane, which is extended straight beyond its end."""
    line = LineString(lane.shape)
    at = line.length - before_end_m
    near = max(min(at, line.length) - 0.5, 0.0)
    a, b = (np.array(line.interpolate(where).coords[0]) for where in (near, min(near + 0.5, line.length)))
    forward = (b - a) / max(float(np.hypot(*(b - a))), 1e-9)
    left = side * np.array([-forward[1], forward[0]])
    middle = a + (at - near) * forward
    return Marking("stop_line", middle + np.outer((-0.5, 0.5), lane.width * left), STOP_LINE_M, 0.0, 0.0)


def _entry(net: RoadNet, edge: Edge) -> Iterator[Marking]:
    """Yield the stop line or give-way line across the driving and bicycle lanes at the end of an edge."""
    states = set(net.right_of_way.get(edge.id, ""))
    lanes = [lane for lane in edge.lanes if lane.kind in ("driving", "bicycle") and len(lane.shape) > 1]
    if not lanes or not states:
        return
    stops = net.junctions[edge.end].kind.startswith("traffic_light") or "s" in states
    if not stops and states != {"m"}:
        return
    ends = []
    for lane, side in ((lanes[0], -0.5), (lanes[-1], 0.5)):
        a, b = lane.shape[-2], lane.shape[-1]
        forward = (b - a) / np.hypot(*(b - a))
        inset = 0.1 if len(lanes) == 1 or side < 0 else 0.15
        left = net.side * np.array([-forward[1], forward[0]])
        ends.append(b - TO_STOP_M * forward + (side * lane.width - np.sign(side) * inset) * left)
    line = np.array(ends)
    if stops:
        yield Marking("stop_line", line, STOP_LINE_M, 0.0, 0.0)
    else:
        yield Marking("yield_line", line, YIELD_LINE_M, YIELD_DASH_M, YIELD_GAP_M)


def _is_controlled(net: RoadNet, edge: Edge) -> bool:
    """Return whether an edge leads to a traffic light, a stop sign or a give-way sign."""
    junction = net.junctions.get(edge.end)
    return junction is not None and (
        junction.kind.startswith("traffic_light") or bool(set(net.right_of_way.get(edge.id, "")) & {"s", "m"})
    )


def _bends(net: RoadNet) -> dict[str, str]:
    """Return the internal edges that continue a street through a node with two neighbours, as edge -> junction."""
    neighbours: dict[str, set[str]] = {}
    for edge in net.streets:
        neighbours.setdefault(edge.end, set()).add(edge.start)
        neighbours.setdefault(edge.start, set()).add(edge.end)
    through = {name for name, others in neighbours.items() if len(others) == 2}
    straight = {
        connection.via.rpartition("_")[0] for connection in net.connections if connection.turn in ("s", "L", "R")
    }
    return {
        edge.id: name
        for edge in net.edges.values()
        if edge.function == "internal" and edge.id in straight
        for name in [edge.id[1:].rpartition("_")[0]]
        if name in through and not net.junctions[name].kind.startswith("traffic_light")
    }


def _beside(lane: Lane, left_m: float, side: int) -> Array:
    """Return the line `left_m` [m] to the left of a lane's middle; with left-hand traffic (`side` -1) to the right."""
    line = LineString(lane.shape).offset_curve(side * left_m, join_style="mitre")
    parts = _lines(line)
    return np.asarray(max(parts, key=lambda part: part.length).coords) if parts else lane.shape


def _coincide(one: Array, other: Array) -> bool:
    """Return whether two polylines (K, 2) [m] coincide within `SAME_LINE_M`, at three points of `other`."""
    line = LineString(one)
    whole = LineString(other)
    inner = [whole.interpolate(share, normalized=True) for share in (0.25, 0.5, 0.75)]
    return max(line.distance(Point(at)) for at in inner) < SAME_LINE_M


def _lines(shape: BaseGeometry) -> list[LineString]:
    parts = getattr(shape, "geoms", [shape])
    return [part for part in parts if isinstance(part, LineString) and not part.is_empty]
