"""Crosswalks of an OpenDRIVE map, and the crossings that they become in a town's net, in netconvert's plain files.

A crosswalk is an object with an outline, or a marking that is a signal (OpenDRIVE 1.8, 13 and 14).
"""

import copy
import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from shapely.geometry import LineString, Point
from shapely.ops import substring

from flcav.arrays import Array
from flcav.world.map.roads import CARRIAGEWAY, Edge, Lane, RoadNet, read_net
from flcav.world.opendrive.objects.places import TakenOver, enclose_outline, locate_thing, outline_object, read_number
from flcav.world.opendrive.road_surface import Road

PAINTED_CROSSWALK = "1000003"  # type of a signal that is a painted crosswalk
WIDE_M = (1.0, 15.0)  # least and largest width of a crosswalk that is believed
LONG_M = (2.0, 60.0)  # least and largest length, across the road, that is believed


@dataclass(frozen=True)
class Crosswalk:
    """A crosswalk of the map, as the rectangle around it, in the town's frame."""

    centre: Array  # (2,) x, y of the centre [m]
    axes: Array  # (2, 2) unit vectors along the sides, one a row
    sides: Array  # (2,) lengths of these sides [m]

    def along(self, walked: Array) -> tuple[Array, float, float]:
        """Return the unit vector (2,) in which pedestrians walk, and the crosswalk's length and width [m] along it.

        It is the axis nearest to the direction `walked` (2,), with the sign that points along it.
        """
        share = self.axes @ walked
        first = int(np.argmax(np.abs(share)))
        return self.axes[first] * np.sign(share[first]), float(self.sides[first]), float(self.sides[1 - first])


def find_crosswalks(root: ElementTree.Element, offset_m: tuple[float, float]) -> TakenOver[Crosswalk]:
    """Find the crosswalks of the map below `root`; a place in the town is that in the map + `offset_m` (x, y) [m]."""
    found = []
    left = Counter[str]()
    for row in root.iterfind("road"):
        named = [thing for thing in row.iterfind("objects/object") if thing.get("type") == "crosswalk"]
        painted = [signal for signal in row.iterfind("signals/signal") if signal.get("type") == PAINTED_CROSSWALK]
        if not named and not painted:
            continue
        road = Road(row)
        for outline in [outline_object(road, thing) for thing in named] + [_outline(road, one) for one in painted]:
            if outline is None:
                left["no place or outline"] += 1
                continue
            crosswalk = _enclose(outline + offset_m)
            if crosswalk is None:
                left["no size of a crosswalk"] += 1
            else:
                found.append(crosswalk)
    return TakenOver(tuple(found), left)


def _outline(road: Road, marking: ElementTree.Element) -> Array | None:
    """Compute the corners (4, 2) [m], in the map's frame, of a crosswalk that is a signal.

    The signal's width is the length across the road, its value the width along it. None without a place or believed
    extents.
    """
    place = locate_thing(road, marking)
    across, along = read_number(marking, "width"), read_number(marking, "value")
    if place is None or not (LONG_M[0] <= across <= LONG_M[1] and WIDE_M[0] <= along <= WIDE_M[1]):
        return None
    forward = np.array([np.cos(place[2]), np.sin(place[2])])
    left = np.array([-forward[1], forward[0]])
    return place[:2] + np.array([a * along / 2 * forward + b * across / 2 * left for a, b in CORNERS])


CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))


def _enclose(outline: Array) -> Crosswalk | None:
    """Enclose an outline (K, 2) [m] in the smallest rectangle; None where its sides are not those of a crosswalk."""
    rectangle = enclose_outline(outline)
    if rectangle is None:
        return None
    sides = rectangle.sides
    if not (WIDE_M[0] <= sides.min() <= WIDE_M[1] and LONG_M[0] <= sides.max() <= LONG_M[1]):
        return None
    return Crosswalk(rectangle.centre, rectangle.edges / sides[:, None], sides)


NEAR_M = 8.0  # largest distance of a crosswalk from the guessed crossing at a junction that it replaces
ALIGNED = np.cos(np.radians(30.0))  # least cosine of the angle between the two
ENDS_M = 12.0  # least distance of a crossing from the ends of its street; nearer ones belong to the junction
ON_ROAD_M = 1.5  # largest distance of the middle of a crosswalk from the lanes that it crosses
BEYOND_M = 3.0  # largest distance of the end of a crosswalk from the kerb
SAME_M = 1.0  # largest distance of the middle lines of both directions of a street


@dataclass(frozen=True)
class _Guess:
    """A crossing that netconvert has guessed at a junction."""

    row: ElementTree.Element  # <crossing> of the plain connections
    line: Array  # (2, 2) ends of the middle line, in the town's frame [m]


def take_crosswalks(prefix: Path, net: Path, crosswalks: tuple[Crosswalk, ...]) -> int:
    """Replace the guessed crossings in the plain files of `prefix` by a map's crosswalks; return their number.

    `net` is the net file of the same edges with the guesses. A crosswalk at a junction replaces the guess next to it; a
    crosswalk in the middle of a street splits the street there. Others are left out, since they lead to no sidewalk.
    """
    trees = {part: ElementTree.parse(f"{prefix}.{part}.xml") for part in ("nod", "edg", "con")}
    plain = {part: tree.getroot() for part, tree in trees.items()}
    guesses = _guesses(plain["con"], net)
    for row in plain["con"].findall("crossing"):
        plain["con"].remove(row)
    matched = _match(crosswalks, guesses)
    for number, guess in matched.items():
        plain["con"].append(_move(guesses[guess], crosswalks[number]))
    streets = _Streets(plain, read_net(net))
    others = [crosswalk for number, crosswalk in enumerate(crosswalks) if number not in matched]
    crossed = [streets.cross(crosswalk, f"crosswalk{number}") for number, crosswalk in enumerate(others)]
    for part, tree in trees.items():
        tree.write(f"{prefix}.{part}.xml")
    return len(matched) + sum(crossed)


def _guesses(connections: ElementTree.Element, net: Path) -> list[_Guess]:
    """List the crossings of the plain connections, with their middle lines from the file `net`."""
    lines: dict[tuple[str, frozenset[str]], Array] = {}
    for row in ElementTree.parse(net).getroot().iterfind("edge"):
        lane = row.find("lane")
        if row.get("function") == "crossing" and lane is not None:
            points = [point.split(",")[:2] for point in lane.get("shape", "").split()]
            name = row.get("id", "")[1:].rpartition("_")[0], frozenset(row.get("crossingEdges", "").split())
            lines[name] = np.array([points[0], points[-1]], dtype=np.float64)
    found = [(row, (row.get("node", ""), frozenset(row.get("edges", "").split()))) for row in connections]
    return [_Guess(row, lines[name]) for row, name in found if row.tag == "crossing" and name in lines]


def _match(crosswalks: tuple[Crosswalk, ...], guesses: list[_Guess]) -> dict[int, int]:
    """Match crosswalks with guesses, by their indices: the nearest pairs first, and none of them twice."""
    pairs = []
    for i, crosswalk in enumerate(crosswalks):
        for j, guess in enumerate(guesses):
            way = guess.line[1] - guess.line[0]
            length = float(np.hypot(*way))
            apart = LineString(guess.line).distance(Point(crosswalk.centre))
            if length and apart <= NEAR_M and float(crosswalk.along(way)[0] @ way) >= ALIGNED * length:
                pairs.append((apart, i, j))
    out: dict[int, int] = {}
    for _, i, j in sorted(pairs):
        if i not in out and j not in out.values():
            out[i] = j
    return out


def _move(guess: _Guess, crosswalk: Crosswalk) -> ElementTree.Element:
    """Move a guessed crossing onto the crosswalk: from kerb to kerb, in its middle and of its width.

    It extends beyond the kerbs to the crosswalk's ends, by at most `BEYOND_M`: kerbs are farther apart in the corners
    of a junction.
    """
    way, length, width = crosswalk.along(guess.line[1] - guess.line[0])
    low, high = (guess.line - crosswalk.centre) @ way
    low, high = min(low, max(-length / 2, low - BEYOND_M)), max(high, min(length / 2, high + BEYOND_M))
    ends = crosswalk.centre + np.outer((low, high), way)
    return _crossing(guess.row.attrib["node"], guess.row.attrib["edges"], guess.row.get("priority", "0"), width, ends)


def _crossing(node: str, edges: str, priority: str, width: float, line: Array) -> ElementTree.Element:
    shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in line)
    values = {"node": node, "edges": edges, "priority": priority, "width": f"{width:.2f}", "shape": shape}
    return ElementTree.Element("crossing", values)


@dataclass(frozen=True)
class _Part:
    """One direction of a street, or a piece of it after cuts."""

    row: ElementTree.Element  # <edge> of the plain file
    line: LineString  # shape of the row, the middle of the road, in the town's frame [m]
    sidewalk: Lane  # outermost lane for pedestrians

    def at(self, place: Array) -> float:
        """Compute the distance along the line [m] to its point nearest to `place` (2,) [m]."""
        return float(self.line.project(Point(place)))


class _Streets:
    """The streets of the plain files, which crosswalks split."""

    def __init__(self, parts: dict[str, ElementTree.Element], net: RoadNet) -> None:
        """Keep the roots of netconvert's plain `nod`, `edg` and `con` files, and the net of the same edges."""
        self._plain, self._net = parts, net
        places = {row.attrib["id"]: f"{row.attrib['x']},{row.attrib['y']}" for row in parts["nod"].iterfind("node")}
        self._rows: dict[str, list[tuple[ElementTree.Element, LineString]]] = {}  # id of the uncut edge -> its pieces
        for row in parts["edg"].iterfind("edge"):
            text = row.get("shape", f"{places[row.attrib['from']]} {places[row.attrib['to']]}")
            points = [[float(value) for value in point.split(",")[:2]] for point in text.split()]
            self._rows[row.attrib["id"]] = [(row, LineString(points))]

    def cross(self, crosswalk: Crosswalk, name: str) -> bool:
        """Cut both directions of the street below a crosswalk at the new node `name`; return whether there is one.

        Both need a sidewalk, and a place that is at least `ENDS_M` from their ends.
        """
        directions = self._find(crosswalk)
        if directions is None:
            return False
        one, other = directions
        across = [_nearest(part.sidewalk.shape, crosswalk.centre) for part in (other, one)]  # netconvert's direction
        walked = across[1] - across[0]
        way, _, width = crosswalk.along(walked)
        if float(way @ walked) < ALIGNED * np.hypot(*walked):
            return False
        kerbs = [side * part.sidewalk.width / 2 for part, side in ((other, 1.0), (one, -1.0))]
        ends = [crosswalk.centre + ((at - crosswalk.centre) @ way + in_) * way for at, in_ in zip(across, kerbs)]
        middle = one.line.interpolate(one.at(crosswalk.centre))
        kind = {"id": name, "x": f"{middle.x:.2f}", "y": f"{middle.y:.2f}", "type": "priority"}
        self._plain["nod"].append(ElementTree.Element("node", kind))
        _, back = self._cut(one, crosswalk.centre, name), self._cut(other, crosswalk.centre, name)
        edges = f"{one.row.attrib['id']} {back}"
        self._plain["con"].append(_crossing(name, edges, "1", width, np.array(ends)))
        return True

    def _find(self, crosswalk: Crosswalk) -> tuple[_Part, _Part] | None:
        """Find both directions of the street below a crosswalk; None without two that can be cut there."""
        near = []
        for edge in self._net.streets:
            lanes = [lane for lane in edge.lanes if lane.kind in CARRIAGEWAY and len(lane.shape) > 1]
            middle = Point(crosswalk.centre)
            apart = min((LineString(lane.shape).distance(middle) - lane.width / 2 for lane in lanes), default=np.inf)
            if apart <= ON_ROAD_M and edge.lanes_of("sidewalk"):
                near.append((apart, edge))
        for _, edge in sorted(near, key=lambda item: (item[0], item[1].id)):
            part = self._part(edge, crosswalk.centre)
            for back in self._net.streets:
                if (back.start, back.end) == (edge.end, edge.start) and back.lanes_of("sidewalk"):
                    other = self._part(back, crosswalk.centre)
                    if part and other and part.line.distance(other.line) < SAME_M:
                        return part, other
        return None

    def _part(self, edge: Edge, place: Array) -> _Part | None:
        """Return the part of an edge at `place` (2,) [m]; None near the ends of the part."""
        rows = self._rows.get(edge.id, [])
        if not rows:
            return None
        row, line = min(rows, key=lambda item: item[1].distance(Point(place)))
        part = _Part(row, line, edge.lanes_of("sidewalk")[-1])
        return part if ENDS_M <= part.at(place) <= line.length - ENDS_M else None

    def _cut(self, part: _Part, place: Array, node: str) -> str:
        """Cut a part at the node; return the id of the second piece, from which the connections onward start."""
        before = part.row.attrib["id"]
        along = part.at(place)
        after = f"{before}.{node}"
        second = copy.deepcopy(part.row)
        second.attrib |= {"id": after, "from": node}
        part.row.attrib["to"] = node
        for row in self._plain["con"]:
            if row.get("from") == before:
                row.set("from", after)
            if row.tag == "crossing" and row.get("node") == second.get("to"):
                row.set("edges", " ".join(after if edge == before else edge for edge in row.get("edges", "").split()))
        lines = [LineString(substring(part.line, *span).coords) for span in ((0.0, along), (along, part.line.length))]
        for row, line in zip((part.row, second), lines):
            row.set("shape", " ".join(f"{x:.2f},{y:.2f}" for x, y in line.coords))
        self._plain["edg"].append(second)
        for known in self._rows.values():
            if any(row is part.row for row, _ in known):
                known[:] = [item for item in known if item[0] is not part.row]
                known += zip((part.row, second), lines)
        return after


def _nearest(line: Array, place: Array) -> Array:
    """Find the point (2,) of a line (K, 2) that is nearest to a place (2,), all [m]."""
    whole = LineString(line)
    at = whole.interpolate(whole.project(Point(place)))
    return np.array([at.x, at.y])
