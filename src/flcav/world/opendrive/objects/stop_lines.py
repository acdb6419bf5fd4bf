"""Stop lines of an OpenDRIVE map: objects across a road, and markings that are signals (OpenDRIVE 1.8, 13 and 14)."""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import LineString, Point

from flcav.arrays import Array
from flcav.world.map.parameters import StopLineParameters
from flcav.world.map.roads import Lane, RoadNet
from flcav.world.opendrive.objects.places import TakenOver, locate_thing, outline_object
from flcav.world.opendrive.road_surface import Road

PAINTED_STOP_LINE = "294"  # type of a signal that is a painted stop line: its number in the German catalogue
SUBTYPE = "signalLines"  # subtype of an object `roadMark` that is a stop line
WIDE_M = (1.5, 30.0)  # least and largest length of a line that is believed
STOPPED = ("driving", "bicycle")  # kinds of lanes with stop lines
ACROSS_M = 20.0  # distance to both sides of a signal within which its lanes are searched
BEFORE_M, BEYOND_M = 25.0, 6.0  # largest distance of a line before and beyond the end of its lane in the net
GAP_M = 1.0  # distance of a stopping vehicle from a line, SUMO's default
BEFORE_CROSSING_M = 0.6  # distance of the middle of a line from the crossing behind it
ASKEW = math.cos(math.radians(60.0))  # cosine of the least angle between a line and its lane
AHEAD = math.cos(math.radians(30.0))  # cosine of the largest angle between a lane and the traffic of its signal


@dataclass(frozen=True)
class _Line:
    """A stop line of the map in the town's frame."""

    ends: Array  # (2, 2) both ends [m]; for a signal, the points `ACROSS_M` to its sides
    ahead: Array | None  # (2,) unit vector of the traffic that stops at a signal; None for an object


@dataclass(frozen=True)
class _Crossed:
    """A lane that a line crosses, the lane being continued straight on."""

    edge: str  # id of the lane's edge
    lane: str  # id of the lane
    before_end_m: float  # distance of the line before the end of the lane; negative beyond it
    aside_m: float  # distance of the lane's border from the middle of the line; 0 inside the lane


def find_stop_lines(
    root: ElementTree.Element, offset_m: tuple[float, float], net: RoadNet
) -> TakenOver[StopLineParameters]:
    """Find the stop lines of the map below `root` near the ends of the lanes of `net`.

    A place in the town is that in the map + `offset_m` (x, y) [m].
    """
    found: dict[str, float] = {}
    taken = 0
    left = Counter[str]()
    ends = [
        (edge.id, lane, _go_on(lane))
        for edge in net.streets
        for lane in edge.lanes
        if lane.kind in STOPPED and len(lane.shape) > 1
    ]
    for row in root.iterfind("road"):
        for line in _list_lines(row, np.array(offset_m)):
            lanes = [] if line is None else _choose(line, [*_cross(line, ends)], net)
            if line is None:
                left["no place or length"] += 1
            elif not lanes:
                left["no lane ends there"] += 1
            else:
                taken += 1
                found |= {crossed.lane: crossed.before_end_m for crossed in lanes if crossed.lane not in found}
    rows = (StopLineParameters(lane=lane, before_end_m=round(found[lane], 2)) for lane in found)
    return TakenOver(tuple(rows), left, taken)


def _list_lines(row: ElementTree.Element, offset_m: Array) -> Iterator[_Line | None]:
    """Yield the stop lines along one road of the map; None for one without a place or a believed length."""
    things = [thing for thing in row.iterfind("objects/object") if _is_stop_line(thing)]
    signals = [signal for signal in row.iterfind("signals/signal") if signal.get("type") == PAINTED_STOP_LINE]
    if not things and not signals:
        return
    road = Road(row)
    for thing in things:
        outline = outline_object(road, thing)
        if outline is None:
            yield None
            continue
        apart = np.hypot(*(outline[:, None] - outline[None]).T)
        i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
        believed = WIDE_M[0] <= apart[i, j] <= WIDE_M[1]
        yield _Line(outline[[i, j]] + offset_m, None) if believed else None
    for signal in signals:
        place = locate_thing(road, signal)
        if place is None:
            yield None
            continue
        heading = place[2] + (math.pi if signal.get("orientation") == "-" else 0.0)
        ahead = np.array([math.cos(heading), math.sin(heading)])
        across = ACROSS_M * np.array([-ahead[1], ahead[0]])
        yield _Line(np.array([place[:2] - across, place[:2] + across]) + offset_m, ahead)


def _is_stop_line(thing: ElementTree.Element) -> bool:
    """Return whether an object is a stop line, by its subtype or by its name."""
    if thing.get("type") == "roadMark" and thing.get("subtype") == SUBTYPE:
        return True
    return "".join(filter(str.isalpha, thing.get("name", ""))).lower().startswith("stopline")


def _go_on(lane: Lane) -> LineString:
    """Continue the middle line of a lane straight on for `BEYOND_M`."""
    step = lane.shape[-1] - lane.shape[-2]
    beyond = lane.shape[-1] + BEYOND_M * step / max(float(np.hypot(*step)), 1e-9)
    return LineString([*lane.shape, beyond])


def _cross(line: _Line, ends: list[tuple[str, Lane, LineString]]) -> Iterator[_Crossed]:
    """Yield the lanes that a line crosses near their ends; `ends` are edge id, lane and its continued middle line."""
    across = LineString(line.ends)
    way = line.ends[1] - line.ends[0]
    for edge, lane, longer in ends:
        step = lane.shape[-1] - lane.shape[-2]
        step = step / max(float(np.hypot(*step)), 1e-9)
        if abs(step @ way) > ASKEW * np.hypot(*way) or (line.ahead is not None and step @ line.ahead < AHEAD):
            continue
        crossing = longer.intersection(across)
        if crossing.is_empty:
            continue
        at = crossing.centroid
        before = longer.length - BEYOND_M - longer.project(at)
        if before < min(BEFORE_M, longer.length - BEYOND_M - 2 * GAP_M):
            aside = at.distance(across.centroid)
            yield _Crossed(edge, lane.id, before, max(aside - lane.width / 2, 0.0))


def _choose(line: _Line, crossed: list[_Crossed], net: RoadNet) -> list[_Crossed]:
    """Choose one of the edges crossed: the one nearest to a signal, else the one that ends next behind the line.

    Returns the crossed lanes of that edge in the order of the edge.
    """
    if not crossed:
        return []

    def rate(lane: _Crossed) -> tuple[float, bool, float]:
        aside = 0.0 if line.ahead is None else round(lane.aside_m, 1)
        return aside, lane.before_end_m < -0.5, abs(lane.before_end_m)

    edge = net.edges[min(crossed, key=rate).edge]
    order = [lane.id for lane in edge.lanes]
    return sorted((lane for lane in crossed if lane.edge == edge.id), key=lambda lane: order.index(lane.lane))


def add_crossing_lines(net: RoadNet, known: tuple[StopLineParameters, ...]) -> tuple[StopLineParameters, ...]:
    """Return the known stop lines, and further ones where a crossing lies across the lanes before a light.

    netconvert ends lanes before the crossings that it has guessed; those of a map may lie before these ends.
    """
    taken = {line.lane.rpartition("_")[0] for line in known}
    crossings = [
        LineString(edge.lanes[0].shape).buffer(edge.lanes[0].width / 2, cap_style="flat")
        for edge in net.edges.values()
        if edge.function == "crossing" and len(edge.lanes[0].shape) > 1
    ]
    rows = []
    for edge in net.streets:
        if edge.id in taken or not net.junctions[edge.end].kind.startswith("traffic_light"):
            continue
        for lane in edge.lanes:
            if lane.kind not in STOPPED or len(lane.shape) < 2:
                continue
            line = LineString(lane.shape)
            inside = [line.intersection(area) for area in crossings if area.intersects(line)]
            starts = [line.project(Point(xy)) for piece in inside for xy in shapely.get_coordinates(piece)]
            near = [line.length - along + BEFORE_CROSSING_M for along in starts if along > line.length - BEFORE_M]
            if near and max(near) < line.length - 2 * GAP_M:
                rows.append(StopLineParameters(lane=lane.id, before_end_m=round(max(near), 2)))
    return (*known, *rows)


def stop_at_lines(net: Path, lines: tuple[StopLineParameters, ...]) -> None:
    """Write stop offsets into the net file `net` for the lines that lie before the ends of their lanes."""
    before = {line.lane: line.before_end_m + GAP_M for line in lines if line.before_end_m > 0}
    if not before:
        return
    tree = ElementTree.parse(net)
    for row in tree.getroot().iterfind("edge/lane"):
        offset = before.get(row.get("id", ""))
        if offset is not None:
            row.insert(0, ElementTree.Element("stopOffset", {"value": f"{offset:.2f}", "vClasses": "all"}))
    tree.write(net, encoding="utf-8", xml_declaration=True)
