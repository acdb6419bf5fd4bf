"""Rewriting of netconvert's plain nodes, edges and connections as the streets of a town.

Access to lanes is reassigned: vehicles use the driving lanes, pedestrians the sidewalk nearest to them (added to
town streets where a map has no sidewalk at all), and other lanes keep their place but are closed to traffic.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.config import InputError
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.opendrive.document import OPEN_ROADS, Document, RoadType

FAR_M = 5000.0  # a map that reaches farther than this from its origin is moved there
SIDEWALK_M = 2.0  # width of an added sidewalk
PARKING_M = (1.9, 5.0)  # widths of a shoulder along a town street that becomes a parking lane
SHORT_M = 60.0  # edges shorter than this are too short to change lanes
ARTERIAL = (
    16.0  # speed limit [m/s] from which a street is an arterial; one with several driving lanes per direction is, too
)
WALKED = ("sidewalk", "walking")  # types of lanes for pedestrians in OpenDRIVE
SHARED = ("allow", "disallow", "width", "speed")  # attributes that netconvert writes at the edge for all its lanes
PRIORITY = {"arterial": "3", "open": "3", "street": "2"}  # SUMO's, by street type
ALLOWED = {  # attributes of a SUMO lane, by kind
    "driving": {"disallow": "pedestrian"},
    "bicycle": {"allow": "bicycle"},
    "sidewalk": {"allow": "pedestrian"},
    "parking": {"disallow": "all", "type": "parking"},
    "shoulder": {"disallow": "all", "type": "shoulder"},
}


@dataclass(frozen=True)
class MapChanges:
    """The changes made to a map."""

    offset_m: tuple[float, float]  # translation x, y from map to town coordinates [m]
    sidewalks_added: bool


@dataclass(frozen=True)
class _Lane:
    """A lane of the town."""

    kind: str  # a key of ALLOWED
    width: float  # [m]
    before: int | None  # its index in the map; None for an added lane


def rewrite_streets(prefix: Path, document: Document, origin: Path) -> MapChanges:
    """Rewrite the plain files named `prefix` in place, as a town's streets; return the changes.

    Raises `InputError`, which names the map `origin`, where no road has a driving lane.
    """
    nodes, edges, connections = (ElementTree.parse(f"{prefix}.{part}.xml") for part in ("nod", "edg", "con"))
    rows = edges.getroot().findall("edge")
    _write_widths(rows, read_made_net(Path(f"{prefix}.net.xml"), origin))
    add = not any(lane.get("type") in WALKED for row in rows for lane in _plain_lanes(row))
    index_of: dict[str, dict[int, int]] = {}  # edge -> index of a lane with traffic in the map -> in the town
    added = False
    for row in rows:
        road = find_road(row.attrib["id"], document)
        lanes = _lanes(row, road, add)
        if not any(lane.kind == "driving" for lane in lanes):
            edges.getroot().remove(row)
            continue
        added |= any(lane.before is None for lane in lanes)
        _write_edge(row, lanes, road)
        index_of[row.attrib["id"]] = {
            lane.before: i
            for i, lane in enumerate(lanes)
            if lane.before is not None and lane.kind in ("driving", "bicycle")
        }
    if not index_of:
        raise InputError(f"{origin}: has no road with a lane for driving")
    _connect(connections.getroot(), index_of)
    places = {row.attrib["id"]: f"{row.attrib['x']},{row.attrib['y']}" for row in nodes.getroot().findall("node")}
    lengths = {row.attrib["id"]: _length(row, places) for row in edges.getroot().findall("edge")}
    _open_short_lanes(connections.getroot(), lengths)
    _rule(nodes.getroot(), edges.getroot().findall("edge"), document)
    offset = _move(nodes.getroot(), edges.getroot(), connections.getroot())
    for part, tree in (("nod", nodes), ("edg", edges), ("con", connections)):
        tree.write(f"{prefix}.{part}.xml")
    return MapChanges(offset, added)


def read_made_net(path: Path, origin: Path) -> RoadNet:
    """Return the road net that netconvert made of the map `origin`. Raises `InputError`, naming the map, if invalid."""
    try:
        return read_net(path)
    except InputError as error:
        raise InputError(f"{origin}: netconvert makes no net of it ({str(error).removeprefix(f'{path}: ')})") from None


def _write_widths(rows: list[ElementTree.Element], net: RoadNet) -> None:
    """Write the lane widths of the net to the edges' rows, since netconvert's plain edges leave out shared widths."""
    width = {lane.id: lane.width for edge in net.edges.values() for lane in edge.lanes}
    for row in rows:
        lanes = _plain_lanes(row)
        for child in row.findall("lane"):
            row.remove(child)
        for i, lane in enumerate(lanes):
            exact = width.get(f"{row.attrib['id']}_{i}", float(lane.get("width", "3.2")))
            ElementTree.SubElement(row, "lane", {**lane, "index": str(i), "width": f"{exact:.2f}"})


def find_road(edge: str, document: Document) -> RoadType:
    """Return the road of an edge, whose id in netconvert is the road's with a sign in front and a section behind.

    A closed road is cut into "1#0", "1#1".
    """
    name = edge.removeprefix("-").partition("#")[0]
    while name not in document.roads and "." in name:
        name = name.rpartition(".")[0]
    return document.roads.get(name, RoadType("unknown", None))


def _lanes(row: ElementTree.Element, road: RoadType, add_sidewalk: bool) -> list[_Lane]:
    """Return the town's lanes of an edge, from kerb to centre line; those beyond the sidewalk are left out."""
    plain = _plain_lanes(row)
    kinds = [_kind(lane) for lane in plain]
    town = road.kind not in OPEN_ROADS
    first_driven = kinds.index("driving") if "driving" in kinds else 0
    walked = max((i for i in range(first_driven) if kinds[i] == "sidewalk"), default=None)
    out = [_Lane("sidewalk", SIDEWALK_M, None)] if walked is None and add_sidewalk and town else []
    for i in range(walked or 0, len(plain)):
        width, kind = float(plain[i].get("width", "3.2")), kinds[i]
        if kind == "sidewalk" and i != walked:
            kind = "shoulder"
        if kind == "shoulder" and i < first_driven and town and PARKING_M[0] <= width <= PARKING_M[1]:
            kind = "parking"
        out.append(_Lane(kind, width, i))
    return out


def _plain_lanes(row: ElementTree.Element) -> list[dict[str, str]]:
    """Return the attributes of an edge's lanes by index, including those that netconvert writes at the edge."""
    by_index = {int(lane.attrib["index"]): lane.attrib for lane in row.iterfind("lane")}
    shared = {name: row.attrib[name] for name in SHARED if name in row.attrib}
    count = int(row.get("numLanes", len(by_index) or 1))
    types = row.get("type", "").split("|")
    lane_types = types if len(types) == count else types[:1] * count
    return [{"type": lane_types[i], **shared, **by_index.get(i, {})} for i in range(count)]


def _kind(lane: dict[str, str]) -> str:
    """Return the kind of a lane, a key of `ALLOWED`, from its OpenDRIVE type and SUMO's permissions."""
    kind = lane.get("type", "driving")
    if kind in WALKED:
        return "sidewalk"
    if kind == "biking":
        return "bicycle"
    if kind == "parking":
        return "parking"
    allowed = lane.get("allow")
    closed = lane.get("disallow") == "all" or (allowed is not None and "passenger" not in allowed.split())
    return "shoulder" if closed else "driving"


def _write_edge(row: ElementTree.Element, lanes: list[_Lane], road: RoadType) -> None:
    """Rewrite an edge in place: street type, priority, speed limit, and its lanes with their permissions."""
    old = _plain_lanes(row)
    driven = [lane.before for lane in lanes if lane.kind == "driving" and lane.before is not None]
    speed = road.speed or float(old[driven[0]].get("speed", "13.89"))
    busy = len(driven) > 1 or speed >= ARTERIAL
    kind = "open" if road.kind in OPEN_ROADS else "arterial" if busy else "street"
    for child in list(row):
        row.remove(child)
    for name in SHARED:
        row.attrib.pop(name, None)
    row.attrib |= {"type": kind, "priority": PRIORITY[kind], "numLanes": str(len(lanes)), "speed": f"{speed:.2f}"}
    for i, lane in enumerate(lanes):
        ElementTree.SubElement(row, "lane", {"index": str(i), "width": f"{lane.width:.2f}", **ALLOWED[lane.kind]})


def _connect(root: ElementTree.Element, kept: dict[str, dict[int, int]]) -> None:
    """Rewrite the connections in place with the town's lane indices; connections of lanes not `kept` are removed."""
    for row in list(root):
        if row.tag != "connection":
            continue
        start, end = kept.get(row.get("from", "")), kept.get(row.get("to", ""))
        here = start.get(int(row.get("fromLane", "-1"))) if start else None
        there = end.get(int(row.get("toLane", "-1"))) if end else None
        if here is None or there is None:
            root.remove(row)
            continue
        ends = {"from": row.attrib["from"], "to": row.attrib["to"], "fromLane": str(here), "toLane": str(there)}
        shape = {"shape": row.attrib["shape"]} if "shape" in row.attrib else {}
        row.clear()
        row.attrib |= ends | shape


def _open_short_lanes(root: ElementTree.Element, length: dict[str, float]) -> None:
    """Connect every lane of a short edge to all edges that any of its lanes leads to.

    Without room to change lanes, two vehicles that need to swap lanes would deadlock. `length` maps edges to their
    lengths [m].
    """
    ways: dict[str, dict[str, dict[int, int]]] = {}  # edge -> next edge -> lane -> its lane
    for row in root.findall("connection"):
        onward = ways.setdefault(row.attrib["from"], {}).setdefault(row.attrib["to"], {})
        onward[int(row.attrib["fromLane"])] = int(row.attrib["toLane"])
    for start, onward in ways.items():
        if length[start] >= SHORT_M:
            continue
        lanes = sorted({lane for ends in onward.values() for lane in ends})
        for end, ends in onward.items():
            for lane in lanes:
                if lane not in ends:
                    nearest = min(ends, key=lambda other: abs(other - lane))
                    values = {"from": start, "to": end, "fromLane": str(lane), "toLane": str(ends[nearest])}
                    ElementTree.SubElement(root, "connection", values)


def _length(row: ElementTree.Element, places: dict[str, str]) -> float:
    """Return the length of an edge [m]; an edge without a shape is straight between its nodes at `places`."""
    shape = row.get("shape", f"{places[row.attrib['from']]} {places[row.attrib['to']]}")
    points = np.array([point.split(",")[:2] for point in shape.split()], dtype=np.float64)
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def _rule(root: ElementTree.Element, edges: Iterable[ElementTree.Element], document: Document) -> None:
    """Set the types of the nodes: traffic lights only where three or more streets meet, stop signs as in the map."""
    neighbours: dict[str, set[str]] = {}
    for edge in edges:
        neighbours.setdefault(edge.attrib["from"], set()).add(edge.attrib["to"])
        neighbours.setdefault(edge.attrib["to"], set()).add(edge.attrib["from"])
    for node in root.findall("node"):
        name = node.attrib["id"]
        junction = len(neighbours.get(name, ())) > 2
        lights = junction and node.get("type", "").startswith("traffic_light")
        node.attrib.pop("tl", None)
        node.set("type", "traffic_light" if lights else "priority_stop" if name in document.stops else "priority")


def _move(
    nodes: ElementTree.Element, edges: ElementTree.Element, connections: ElementTree.Element
) -> tuple[float, float]:
    """Translate a map that reaches beyond `FAR_M` to the origin, in place; return the offset x, y [m]."""
    rows = nodes.findall("node")
    at = np.array([(float(row.attrib["x"]), float(row.attrib["y"])) for row in rows])
    if np.abs(at).max() <= FAR_M:
        return 0.0, 0.0
    dx, dy = (float(v) for v in -np.round((at.min(axis=0) + at.max(axis=0)) / 2, -2))
    for row, (x, y) in zip(rows, at):
        row.attrib |= {"x": f"{x + dx:.2f}", "y": f"{y + dy:.2f}"}
    for row in [*edges.findall("edge"), *connections.findall("connection")]:
        points = [tuple(float(v) for v in point.split(",")[:2]) for point in row.get("shape", "").split()]
        if points:
            row.set("shape", " ".join(f"{x + dx:.2f},{y + dy:.2f}" for x, y in points))
    return dx, dy
