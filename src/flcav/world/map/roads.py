"""SUMO road networks: edges with their lanes, junctions, connections and right of way.

Format: https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks.html
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, read_xml, shorten

Array = NDArray[np.float64]

LaneKind = Literal["driving", "bicycle", "parking", "shoulder", "sidewalk", "crossing", "walkingarea"]
CARRIAGEWAY: tuple[LaneKind, ...] = ("driving", "bicycle", "parking", "shoulder")  # the last two without traffic

FARTHEST_M = 1e8  # largest number in a net, coordinates included: more than the Earth's circumference
ONLY_FOR: dict[str, LaneKind] = {"pedestrian": "sidewalk", "bicycle": "bicycle"}


@dataclass(frozen=True)
class Lane:
    """One lane of an edge."""

    id: str
    kind: LaneKind
    shape: Array  # (K, 2) centre line in driving direction, outline of a walkingarea, world [m]
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

    def lanes_of(self, kind: str) -> tuple[Lane, ...]:
        """Return the lanes of a kind, from the kerb to the middle."""
        return tuple(lane for lane in self.lanes if lane.kind == kind)


@dataclass(frozen=True)
class Junction:
    """A node of the net, where edges meet."""

    id: str
    kind: str  # SUMO's type: priority, priority_stop, traffic_light, ...
    centre: Array  # (2,) [m]
    shape: Array  # (K, 2) outline [m]; empty at a bare node


@dataclass(frozen=True)
class Connection:
    """A link from the end of one lane to the start of another."""

    start: str  # id of the lane it leaves
    end: str  # id of the lane it enters
    via: str  # first lane inside the junction; empty where there is none
    turn: str  # s straight, l left, r right, L and R half left and half right, t U-turn
    light: str  # "junction:link" as in `Trace.light`; empty without a light


@dataclass(frozen=True)
class RoadNet:
    """The parts of a SUMO net from which the town and its traffic are made."""

    edges: dict[str, Edge]
    junctions: dict[str, Junction]
    roundabouts: frozenset[str]  # ids of the junctions on a roundabout
    # edge -> right of way of all links of its driving lanes in SUMO's letters, e.g. "MMm": M has priority, m gives way,
    # s stops, o is at a traffic light, ...
    right_of_way: dict[str, str]
    connections: tuple[Connection, ...]
    side: int = 1  # on which side of the road traffic keeps: 1 right, -1 left

    @property
    def streets(self) -> Iterator[Edge]:
        """Iterate over the edges outside junctions, in the net's order."""
        return (edge for edge in self.edges.values() if edge.function == "normal")


def read_net(path: Path) -> RoadNet:
    """Return the road network of a net file; raises `InputError` where it is missing or no SUMO net."""
    root = read_xml(path, "a SUMO net")
    if root.tag != "net":
        raise InputError(f"{path}: not a SUMO net (its root is <{root.tag}>, expected <net>)")
    try:
        return _net(root)
    except (LookupError, ValueError) as error:
        raise InputError(f"{path}: not a SUMO net ({type(error).__name__}: {error})") from None


def _net(root: ElementTree.Element) -> RoadNet:
    """Return the net below `root`; raises `LookupError` and `ValueError` where something is missing or no number."""
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
    led = [name for each in connections for name in (each.start, each.end, each.via) if name]
    _refuse_unknown("lane", led, lanes)
    side = -1 if root.get("lefthand") in ("1", "true") else 1
    return RoadNet(edges, junctions, frozenset(circling), states, connections, side)


def _refuse_unknown(what: str, named: Iterable[str], known: Container[str]) -> None:
    """Raise `ValueError` for the first name that is not known."""
    for name in named:
        if name not in known:
            raise ValueError(f"no {what} has the id {shorten(name)}")


def _connection(row: ElementTree.Element) -> Connection:
    return Connection(
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
    return Edge(row.attrib["id"], function, row.get("from", ""), row.get("to", ""), row.get("type", ""), lanes)


def _lane_kind(function: str, lane: ElementTree.Element) -> LaneKind:
    """Return the kind of a lane from its edge's function and the vehicle classes that may use it."""
    if function == "crossing" or function == "walkingarea":
        return function
    if lane.get("disallow") == "all":
        return "shoulder" if lane.get("type") == "shoulder" else "parking"
    return ONLY_FOR.get(lane.get("allow", ""), "driving")


def _points(text: str) -> Array:
    """Return the points (K, 2) of SUMO's "x,y x,y ..." without heights; raises `ValueError` for other text."""
    rows = [[_number(part) for part in point.split(",")[:2]] for point in text.split()]
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _number(text: str) -> float:
    """Return a number; raises `ValueError` for NaN, for other text and beyond `FARTHEST_M`."""
    value = float(text)
    if not abs(value) <= FARTHEST_M:
        raise ValueError(f"{shorten(text)} is no place in a town")
    return value
