"""SUMO road networks: edges with their lanes, junctions, connections, right of way, and routes along the lanes.

Format: https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks.html
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from flcav.arrays import Array, Ints
from flcav.config import InputError, read_xml, shorten

LaneKind = Literal["driving", "bicycle", "parking", "shoulder", "sidewalk", "crossing", "walkingarea"]
CARRIAGEWAY: tuple[LaneKind, ...] = ("driving", "bicycle", "parking", "shoulder")  # the last two without moving traffic

FARTHEST_M = 1e8  # largest number in a net, coordinates included: more than the Earth's circumference
ONLY_FOR: dict[str, LaneKind] = {"pedestrian": "sidewalk", "bicycle": "bicycle"}


@dataclass(frozen=True)
class Lane:
    """A lane of an edge."""

    id: str
    kind: LaneKind
    shape: Array  # (K, 2) centre line in driving direction; outline of a walkingarea; world frame [m]
    width: float  # [m]
    speed: float  # limit [m/s]


@dataclass(frozen=True)
class Edge:
    """One direction of a street, or an edge inside a junction."""

    id: str
    function: str  # normal | internal | crossing | walkingarea
    start: str  # id of the junction it comes from; empty inside a junction
    end: str  # id of the junction it leads to; empty inside a junction
    type: str  # street type of the town's parameters
    lanes: tuple[Lane, ...]  # from the kerb to the middle of the road
    name: str = ""  # of the street; empty where the net has none

    def lanes_of(self, kind: str) -> tuple[Lane, ...]:
        """Return the lanes of a kind, from the kerb to the middle."""
        return tuple(lane for lane in self.lanes if lane.kind == kind)


@dataclass(frozen=True)
class Junction:
    """A node of the net, where edges meet."""

    id: str
    kind: str  # SUMO's type: priority, priority_stop, traffic_light, ...
    centre: Array  # (2,) world frame [m]
    shape: Array  # (K, 2) outline, world frame [m]; empty for a bare node


@dataclass(frozen=True)
class LaneConnection:
    """A link from the end of one lane to the start of another."""

    start: str  # id of the lane it leaves
    end: str  # id of the lane it enters
    via: str  # first lane inside the junction; empty where there is none
    turn: str  # s straight, l left, r right, L and R half left and half right, t U-turn
    light: str  # "junction:link" as in `Trace.light`; empty without a light


@dataclass(frozen=True)
class RoadNet:
    """A SUMO road net, as far as towns and traffic need it."""

    edges: dict[str, Edge]
    junctions: dict[str, Junction]
    roundabouts: frozenset[str]  # ids of the junctions on a roundabout
    # edge -> right of way of all links of its driving lanes in SUMO's letters, e.g. "MMm": M has priority, m gives way,
    # s stops, o is at a traffic light, ...
    right_of_way: dict[str, str]
    connections: tuple[LaneConnection, ...]
    side: int = 1  # side of the traffic: 1 right, -1 left

    @property
    def streets(self) -> Iterator[Edge]:
        """Iterate over the edges outside junctions, in the net's order."""
        return (edge for edge in self.edges.values() if edge.function == "normal")


def read_net(path: Path) -> RoadNet:
    """Read the road net of a file. Raises `InputError` where it is missing or not a SUMO net."""
    root = read_xml(path, "a SUMO net")
    if root.tag != "net":
        raise InputError(f"{path}: not a SUMO net (its root is <{root.tag}>, expected <net>)")
    try:
        return _net(root)
    except (LookupError, ValueError) as error:
        raise InputError(f"{path}: not a SUMO net ({type(error).__name__}: {error})") from None


def _net(root: ElementTree.Element) -> RoadNet:
    """Parse the net below `root`. Raises `LookupError` and `ValueError` for missing and invalid values."""
    edges = {row.attrib["id"]: _edge(row) for row in root.iterfind("edge")}
    junctions = {
        row.attrib["id"]: Junction(
            row.attrib["id"],
            row.attrib["type"],
            np.array([_number(row.attrib["x"]), _number(row.attrib["y"])]),
            _points(row.get("shape", "")),
        )
        for row in root.iterfind("junction")
        if row.attrib["type"] != "internal"
    }
    circling = [name for row in root.iterfind("roundabout") for name in row.attrib["nodes"].split()]
    states: dict[str, str] = {}
    for row in root.iterfind("connection"):
        edge = edges[row.attrib["from"]]
        if edge.function == "normal" and edge.lanes[int(row.attrib["fromLane"])].kind == "driving":
            states[edge.id] = states.get(edge.id, "") + row.attrib["state"]
    connections = tuple(_connection(row) for row in root.iterfind("connection"))
    ends = [name for edge in edges.values() if edge.function == "normal" for name in (edge.start, edge.end)]
    _refuse_unknown("junction", [*ends, *circling], junctions)
    lanes = {lane.id for edge in edges.values() for lane in edge.lanes}
    led = [name for connection in connections for name in (connection.start, connection.end, connection.via) if name]
    _refuse_unknown("lane", led, lanes)
    side = -1 if root.get("lefthand") in ("1", "true") else 1
    return RoadNet(edges, junctions, frozenset(circling), states, connections, side)


def _refuse_unknown(what: str, named: Iterable[str], known: Container[str]) -> None:
    """Raise `ValueError` for the first name that is not known."""
    for name in named:
        if name not in known:
            raise ValueError(f"no {what} has the id {shorten(name)}")


def _connection(row: ElementTree.Element) -> LaneConnection:
    return LaneConnection(
        f"{row.attrib['from']}_{row.attrib['fromLane']}",
        f"{row.attrib['to']}_{row.attrib['toLane']}",
        row.get("via", ""),
        row.get("dir", ""),
        f"{row.attrib['tl']}:{row.attrib['linkIndex']}" if "tl" in row.attrib else "",
    )


def _edge(row: ElementTree.Element) -> Edge:
    function = row.get("function", "normal")
    lanes = tuple(
        Lane(
            lane.attrib["id"],
            _lane_kind(function, lane),
            _points(lane.attrib["shape"]),
            _number(lane.get("width", "3.2")),
            _number(lane.attrib["speed"]),
        )
        for lane in row.iterfind("lane")
    )
    ends = (row.get("from", ""), row.get("to", ""))
    return Edge(row.attrib["id"], function, *ends, row.get("type", ""), lanes, row.get("name", ""))


def _lane_kind(function: str, lane: ElementTree.Element) -> LaneKind:
    """Return the kind of a lane from its edge's function and the vehicle classes that may use it."""
    if function == "crossing" or function == "walkingarea":
        return function
    if lane.get("disallow") == "all":
        return "shoulder" if lane.get("type") == "shoulder" else "parking"
    return ONLY_FOR.get(lane.get("allow", ""), "driving")


def _points(text: str) -> Array:
    """Parse SUMO's "x,y x,y ..." as points (K, 2) [m], without heights. Raises `ValueError` for other text."""
    rows = [[_number(part) for part in point.split(",")[:2]] for point in text.split()]
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _number(text: str) -> float:
    """Parse a number. Raises `ValueError` for NaN, for other text and beyond `FARTHEST_M`."""
    value = float(text)
    if not abs(value) <= FARTHEST_M:
        raise ValueError(f"{shorten(text)} is no place in a town")
    return value


EDGE = re.compile(r'(<edge id="([^":]+)"(?: from="[^"]*")?(?: to="[^"]*")?)')


def name_streets(net: Path, name_of: Callable[[str], str]) -> None:
    """Write into a net file the names of streets: `name_of` an edge's id, "" where it has none."""

    def add(found: re.Match[str]) -> str:
        name = name_of(found[2])
        return f"{found[0]} name={quoteattr(name)}" if name else found[0]

    text = net.read_text(encoding="utf-8")
    net.write_text(EDGE.sub(add, text), encoding="utf-8")


SHORTEST_M = 20.0  # length of lane above which a route may begin on it
WINDOW_M = 30.0  # distance from the last place on a route within which the next one is searched


@dataclass(frozen=True)
class Route:
    """A route through a town: its centre line, speed limits, traffic lights and lane widths."""

    points: Array  # (K, 2) world frame [m]
    along: Array  # (K,) distance from the start [m], ascending
    speed: Array  # (K,) speed limit from the point on [m/s]
    stops: tuple[tuple[float, str], ...]  # traffic lights on the route: distance [m], entry of `Trace.light`
    width: Array  # (K,) of its lane from the point on [m]

    @property
    def length_m(self) -> float:
        """The length of the route [m]."""
        return float(self.along[-1])

    def at(self, along: ArrayLike) -> Array:
        """Return x, y [m] and heading [rad] (..., 3), world frame, at distances (...) [m]; straight beyond the ends."""
        along = np.asarray(along, np.float64)
        piece = np.clip(np.searchsorted(self.along, along, side="right") - 1, 0, len(self.along) - 2)
        step = self.points[piece + 1] - self.points[piece]
        share = (along - self.along[piece]) / (self.along[piece + 1] - self.along[piece])
        heading = np.arctan2(step[..., 1], step[..., 0])
        return np.concatenate((self.points[piece] + share[..., None] * step, heading[..., None]), axis=-1)

    def limit(self, along: float) -> float:
        """Return the speed limit [m/s] at a distance [m]."""
        return float(self.speed[self._piece(along)])

    def lane_width(self, along: ArrayLike) -> Array:
        """Return the width [m] of the lane at distances (...) [m]."""
        return self.width[self._piece(along)]

    def _piece(self, along: ArrayLike) -> Ints:
        """Return the index of the last point at or before distances [m], 0 before the start."""
        return np.maximum(np.searchsorted(self.along, along, side="right") - 1, 0)

    def project(self, x: float, y: float, near: float) -> tuple[float, float]:
        """Project x, y [m] on the route: return the distance along it and the offset to its left [m].

        The search is limited to distances within `WINDOW_M` of `near` [m].
        """
        start = self.points[:-1]
        step = np.diff(self.points, axis=0)
        length = np.diff(self.along)
        share = np.clip(((np.array((x, y)) - start) * step).sum(axis=1) / length**2, 0.0, 1.0)
        away = np.array((x, y)) - start - share[:, None] * step
        far = (self.along[1:] < near - WINDOW_M) | (self.along[:-1] > near + WINDOW_M)
        nearest = int(np.argmin(np.where(far, np.inf, np.linalg.norm(away, axis=1))))
        left = step[nearest, 0] * away[nearest, 1] - step[nearest, 1] * away[nearest, 0]
        side = float(np.copysign(np.linalg.norm(away[nearest]), left))
        return float(self.along[nearest] + share[nearest] * length[nearest]), side


def draw_route(net: RoadNet, random: np.random.Generator, length_m: float) -> Route:
    """Draw a route of at least `length_m` [m], or to the end of the net, with uniformly random lanes.

    Raises `InputError` where the net has no driving lane of `SHORTEST_M`.
    """
    lanes = {lane.id: (edge, lane) for edge in net.edges.values() for lane in edge.lanes_of("driving")}
    onward: dict[str, list[LaneConnection]] = {}
    for way in net.connections:
        if way.end in lanes and (not way.via or way.via in lanes):
            onward.setdefault(way.start, []).append(way)
    starts = [
        name for name, (edge, lane) in lanes.items() if edge.function == "normal" and _length(lane.shape) > SHORTEST_M
    ]
    if not starts:
        raise InputError(f"no driving lane is longer than {SHORTEST_M:g} m")
    name = starts[int(random.integers(len(starts)))]
    parts, stops, driven = [lanes[name]], [], _length(lanes[name][1].shape)
    while driven < length_m and (ways := onward.get(name)):
        way = ways[int(random.integers(len(ways)))]
        if way.light:
            stops.append((driven, way.light))
        for part in _through(way, lanes, onward):
            parts.append(part)
            driven += _length(part[1].shape)
        name = way.end
    return _join([lane for _, lane in parts], tuple(stops))


def _through(
    way: LaneConnection, lanes: dict[str, tuple[Edge, Lane]], onward: dict[str, list[LaneConnection]]
) -> Iterator[tuple[Edge, Lane]]:
    """Yield the lanes inside a junction that lead to the end of a connection, and that end."""
    via = way.via
    while via:
        yield lanes[via]
        via = next((link.via for link in onward.get(via, ()) if link.end == way.end), "")
    yield lanes[way.end]


def _join(lanes: list[Lane], stops: tuple[tuple[float, str], ...]) -> Route:
    points = np.concatenate([lane.shape for lane in lanes])
    speed, width = (
        np.concatenate([np.full(len(lane.shape), value) for lane, value in zip(lanes, values)])
        for values in ([lane.speed for lane in lanes], [lane.width for lane in lanes])
    )
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    kept = np.concatenate(([True], steps > 1e-3))
    points = points[kept]
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    return Route(points, along, speed[kept], stops, width[kept])


def _length(shape: Array) -> float:
    return float(np.linalg.norm(np.diff(shape, axis=0), axis=1).sum())
