"""Signal heads of an OpenDRIVE map: their places, and the connections of the net they control (OpenDRIVE 1.8, 14)."""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import LineString

from flcav.arrays import Array
from flcav.config import shorten
from flcav.geometry import heading_vectors, left_vectors
from flcav.world.map.parameters import SignalParameters
from flcav.world.map.roads import LaneConnection, RoadNet
from flcav.world.map.signals import ARM_HEAD_M, KERB_HEAD_M
from flcav.world.opendrive.objects.places import TakenOver, locate_thing, read_number
from flcav.world.opendrive.road_surface import Road

Placed = tuple[ElementTree.Element, ElementTree.Element]  # a road, and a signal or a reference to one on it

LIGHT, WALKERS = "1000001", "1000002"  # types of traffic lights: for vehicles, for pedestrians
HEAD_M, WALKERS_HEAD_M = 1.0, 0.7  # heights of a head for vehicles and for pedestrians
HEIGHT_M = (1.8, 9.0)  # least and largest height of the centre of a head for vehicles that is believed
WALKERS_M = (1.5, 4.0)  # the same of a head for pedestrians
WALKERS_UP_M = 2.4  # height of the centre of a head for pedestrians without a believed one
KERB_SIDE_M = 6.0  # largest distance of a head for pedestrians from its end of a crossing
PLACE_M = 15.0  # largest distance of the end of a road in the map from that of its lane in the net
WAY_M = 40.0  # the same for a connection through a junction, the sum over both of its ends
ASKEW = np.cos(np.radians(60.0))  # cosine of the largest angle of a head's axis to its approach; else it faces that
KERB_M = 0.3  # least distance of a mast from the road
FARTHEST_M, STEP_M = 20.0, 0.25  # largest reach of an arm, and step in which a place for its mast is searched


def find_heads(root: ElementTree.Element, offset_m: tuple[float, float], net: RoadNet) -> TakenOver[SignalParameters]:
    """Find the heads of the traffic lights of the map below `root` that belong to a light of `net`.

    A place in the town is that in the map + `offset_m` (x, y) [m]. The connection that a head controls follows from the
    roads that it, or a reference to it, is on. The head has the axis of the map and faces the traffic of the
    connection. A head for pedestrians belongs to the nearest crossing of its road.
    """
    roads = {row.get("id", ""): row for row in root.iterfind("road")}
    named = _list_references(root)
    controllers = {
        row.get("signalId", ""): controller.get("id", "")
        for controller in root.iterfind("controller")
        for row in controller
    }
    ways = _Ways(net, offset_m)
    found = []
    left = Counter[str]()
    for row in roads.values():
        for signal in row.iterfind("signals/signal"):
            if signal.get("dynamic") != "yes":
                continue
            name, kind = signal.get("id", ""), signal.get("type", "")
            place = locate_thing(Road(row), signal, offset_m)
            if kind not in (LIGHT, WALKERS) or place is None:
                head = "no place" if kind in (LIGHT, WALKERS) else f"of the type {shorten(kind)}"
            elif kind == WALKERS:
                head = _place_walkers(signal, place, net, ways, controllers.get(name, ""))
            else:
                way = ways.find([(roads[road], ref) for road, ref in named.get(name, ())], (row, signal))
                head = _place(signal, place, way, ways, controllers.get(name, ""))
            if isinstance(head, str):
                left[head] += 1
            else:
                found.append(head)
    return TakenOver(tuple(found), left)


def _list_references(root: ElementTree.Element) -> dict[str, list[tuple[str, ElementTree.Element]]]:
    """Map the id of a signal to the ids of the roads with references to it, and these references."""
    out: dict[str, list[tuple[str, ElementTree.Element]]] = {}
    for row in root.iterfind("road"):
        for reference in row.iterfind("signals/signalReference"):
            out.setdefault(reference.get("id", ""), []).append((row.get("id", ""), reference))
    return out


class _Ways:
    """The connections of a net that have a light and start at a driving lane."""

    def __init__(self, net: RoadNet, offset_m: tuple[float, float]) -> None:
        self._lanes = {lane.id: lane for edge in net.edges.values() for lane in edge.lanes}
        driven = {lane.id for edge in net.streets for lane in edge.lanes_of("driving")}
        self._lit = [way for way in net.connections if way.light and way.start in driven]
        self._offset = np.array(offset_m)
        lanes = [lane for lane in self._lanes.values() if lane.kind == "driving" and len(lane.shape) > 1]
        self._road = shapely.union_all([LineString(lane.shape).buffer(lane.width / 2) for lane in lanes])
        shapely.prepare(self._road)

    def find(self, references: list[Placed], own: Placed) -> LaneConnection | None:
        """Find the connection that a signal controls; None without one.

        It is searched by the signal's references in junctions, else by its other references, else by its road, `own`.
        Of several connections from the street of the nearest one, one straight on is preferred.
        """
        inside = [place for place in references if _is_inside(place)]
        outside = [place for place in references if not _is_inside(place)]
        for places in (inside, outside, [own]):
            candidates = [
                way
                for row, signal in places
                for start, end in _travelled(row, signal)
                if (way := self._nearest(start + self._offset, end + self._offset, inside=_is_inside((row, signal))))
            ]
            if candidates:
                street = min(candidates, key=lambda item: item[0])[1].start.rpartition("_")[0]
                own_street = [way for _, way in candidates if way.start.rpartition("_")[0] == street]
                return min(own_street, key=lambda way: way.turn != "s")
        return None

    def _nearest(self, start: Array, end: Array, *, inside: bool) -> tuple[float, LaneConnection] | None:
        """Find the connection nearest to a road travelled from `start` (2,) to `end` (2,) [m], and its distance [m].

        Outside junctions only the end counts; of the connections of one lane, the one straight on is taken.
        """
        rated = []
        for way in self._lit:
            before, after = self._lanes[way.start], self._lanes[way.end]
            apart = float(np.hypot(*(before.shape[-1] - (start if inside else end))))
            if inside:
                apart += float(np.hypot(*(after.shape[0] - end)))
            elif (end - start) @ self.heading(way) < ASKEW * np.hypot(*(end - start)):
                continue
            if apart <= (WAY_M if inside else PLACE_M):
                rated.append((round(apart, 3), way.turn != "s", way.light, way))
        nearest = min(rated, key=lambda item: item[:3], default=None)
        return None if nearest is None else (nearest[0], nearest[3])

    def heading(self, way: LaneConnection) -> Array:
        """Compute the unit vector (2,) in which traffic approaches the light of a connection."""
        step = np.diff(self._lanes[way.start].shape[-2:], axis=0)[0]
        return step / max(float(np.hypot(*step)), 1e-9)

    def on_road(self, x: float, y: float) -> bool:
        """Return whether a place [m] in the town is on a driving lane, or within `KERB_M` of one."""
        return bool(shapely.dwithin(self._road, shapely.Point(x, y), KERB_M))


def _is_inside(place: Placed) -> bool:
    """Return whether a road lies in a junction."""
    return place[0].get("junction", "-1") != "-1"


def _travelled(row: ElementTree.Element, signal: ElementTree.Element) -> Iterator[tuple[Array, Array]]:
    """Yield both ends (2,) of a road [m], in the map's frame, in the direction of the traffic that a signal controls.

    The direction is that of the lanes for which the signal is valid; if these go both ways, that of its orientation; if
    that is missing, both directions are yielded.
    """
    side = -1 if row.get("rule") == "LHT" else 1
    lanes = [
        int(lane.get("id", "0")) for lane in row.iterfind("lanes/laneSection/*/lane") if lane.get("type") == "driving"
    ]
    valid = signal.find("validity")
    if valid is not None:
        low, high = sorted(read_number(valid, name) for name in ("fromLane", "toLane"))
        lanes = [lane for lane in lanes if low <= lane <= high] or lanes
    ahead = {lane * side < 0 for lane in lanes if lane}
    if len(ahead) != 1:
        ahead = {"+": {True}, "-": {False}}.get(signal.get("orientation", ""), {True, False})
    line = Road(row).line
    ends = line.at(np.array([0.0, line.length]))[:, :2]
    for forward in sorted(ahead):
        yield (ends[0], ends[1]) if forward else (ends[1], ends[0])


def _place(
    signal: ElementTree.Element,
    place: tuple[float, float, float],
    way: LaneConnection | None,
    ways: _Ways,
    controller: str,
) -> SignalParameters | str:
    """Build the head of a signal, or return the reason why there is none.

    `place` is the signal's x, y [m] in the town and the road's heading [rad]; `way` is the connection that it controls.
    """
    if way is None:
        return "no junction with lights"
    x, y, heading = place
    come = ways.heading(way)
    axis = heading_vectors(heading + read_number(signal, "hOffset"))
    facing = -come if abs(axis @ come) < ASKEW else -np.sign(axis @ come) * axis
    yaw = float(np.arctan2(facing[1], facing[0]))
    up = _read_height(signal, HEAD_M)
    known = HEIGHT_M[0] <= up <= HEIGHT_M[1]
    reach = 0.0
    if ways.on_road(x, y):
        left = left_vectors(yaw)
        steps = (side * step for step in np.arange(STEP_M, FARTHEST_M, STEP_M) for side in (1, -1))
        reach = next((r for r in steps if not ways.on_road(x - r * left[0], y - r * left[1])), math.nan)
        if math.isnan(reach):
            return "above a road, with no place for its mast"
    return SignalParameters(
        x=round(x, 3),
        y=round(y, 3),
        height_m=round(up, 2) if known else ARM_HEAD_M if reach else KERB_HEAD_M,
        yaw_deg=round(math.degrees(yaw) % 360.0, 2),
        reach_m=float(reach),
        light=way.light,
        controller=controller,
    )


def _find_crossing(net: RoadNet, place: tuple[float, float, float]) -> tuple[float, str] | None:
    """Find the crossing with an end nearest to `place`: its direction [rad], away from that end, and its light.

    `place` is x, y [m] in the town and the heading [rad] of the road that the crossing leads across. None without one.
    """
    along = heading_vectors(place[2])
    lights = {way.end: way.light for way in net.connections if way.light}
    rated = []
    for edge in net.edges.values():
        if edge.function != "crossing" or edge.lanes[0].id not in lights or len(edge.lanes[0].shape) < 2:
            continue
        shape = edge.lanes[0].shape
        for here, there in ((shape[0], shape[-1]), (shape[-1], shape[0])):
            apart, way = float(np.hypot(*(here - place[:2]))), there - here
            if apart <= KERB_SIDE_M and abs(way @ along) <= ASKEW * np.hypot(*way):
                rated.append((apart, float(np.arctan2(way[1], way[0])), lights[edge.lanes[0].id]))
    return min(rated)[1:] if rated else None


def _place_walkers(
    signal: ElementTree.Element, place: tuple[float, float, float], net: RoadNet, ways: _Ways, controller: str
) -> SignalParameters | str:
    """Build the head for pedestrians of a signal, which faces those who come across, or return why there is none.

    `place` is the signal's x, y [m] in the town and the road's heading [rad].
    """
    facing = _find_crossing(net, place)
    if facing is None:
        return "for pedestrians, no crossing with lights"
    if ways.on_road(*place[:2]):
        return "for pedestrians, on a road"
    up = _read_height(signal, WALKERS_HEAD_M)
    return SignalParameters(
        x=round(place[0], 3),
        y=round(place[1], 3),
        height_m=round(up, 2) if WALKERS_M[0] <= up <= WALKERS_M[1] else WALKERS_UP_M,
        yaw_deg=round(math.degrees(facing[0]) % 360.0, 2),
        light=facing[1],
        walkers=True,
        controller=controller,
    )


def _read_height(signal: ElementTree.Element, head_m: float) -> float:
    """Compute the height of the centre of a signal's head [m]; a signal higher than two heads includes its post."""
    low, high = read_number(signal, "zOffset"), read_number(signal, "height")
    return low + (high / 2 if high <= 2 * head_m else high - head_m / 2)


def count_controllers(heads: tuple[SignalParameters, ...], net: Path) -> tuple[int, int]:
    """Count a map's controllers with several heads, and those of them whose heads a net file switches alike."""
    states: dict[str, list[str]] = {}
    for row in ElementTree.parse(net).getroot().iterfind("tlLogic"):
        states[row.get("id", "")] = [phase.get("state", "") for phase in row.iterfind("phase")]
    switched: dict[str, list[str]] = {}
    for head in heads:
        if head.controller:
            light, _, link = head.light.rpartition(":")
            switched.setdefault(head.controller, []).append("".join(state[int(link)] for state in states[light]))
    several = [rows for rows in switched.values() if len(rows) > 1]
    return len(several), sum(len({row.lower() for row in rows}) == 1 for rows in several)
