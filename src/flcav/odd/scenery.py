"""Scenery of a town in terms of ISO 34503: drivable area and junctions at a place, from the road network.

Conflict points of a junction are counted as in traffic engineering (FHWA, "Roundabouts: An Informational Guide", 2000,
ch. 5): where paths of vehicles diverge, merge and cross; 32 at a crossroad of single lanes, 9 at a T-junction.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import networkx as nx
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Point
from shapely.geometry.base import BaseGeometry

from flcav.geometry import Array
from flcav.world.map.roads import LaneConnection, RoadNet, read_net
from flcav.world.map.town import Town

Column = Array | NDArray[np.str_]  # NaN and "" are missing

NEAR_M = 15.0  # greatest distance from a place to the junction or parking space that it is at
LANE_M = 12.0  # greatest distance from a place to the centre line of its lane
TURNED = 10.0  # penalty [m] of a lane at 90 degrees to the direction of travel; twice for the opposite direction
SLOPE_M = 5.0  # half the distance over which a gradient is measured
STRAIGHT_M = 20.0  # half the length of a straight road that a place needs
BEFORE_M = 40.0  # from the start of a scenario to the junction
BENT = 0.99  # least ratio of chord to length of a straight road
ARMS = {3: "t_junction", 4: "crossroad"}
CONTROLS = {"traffic_light": "signalised", "priority": "signed", "allway_stop": "signed"}  # by prefix of SUMO's type
ROADS = ((100.0, "radial_road"), (55.0, "distributor_road"), (35.0, "minor_road"))  # up to this limit [km/h]; see docs


@dataclass(frozen=True)
class ScenarioPlace:
    """A place of a town for scenarios: the centre of a junction, or the middle of a straight road (world frame)."""

    town: str
    kind: str  # none (a straight road), t_junction, crossroad, roundabout or other
    control: str  # none, signalised, signed or uncontrolled
    x: float  # [m]
    y: float  # [m]
    approach: tuple[float, float]  # x, y [m] of the end of a lane that leads to it; for a straight road the place
    yaw: float  # direction of that lane [rad]
    start: tuple[float, float, float]  # x, y [m] and yaw [rad] on that lane, up to `BEFORE_M` before its end
    conflicts: int  # conflict points of vehicles


class Scenery:
    """The scenery of one town: its lanes and junctions, with spatial indices."""

    def __init__(self, town: Town) -> None:
        self.town = town
        self.net = read_net(town.net)
        streets = [(edge, lane) for edge in self.net.streets for lane in edge.lanes_of("driving")]
        self._lines = np.array([LineString(lane.shape) for _, lane in streets], dtype=object)
        self._limit = np.array([round(lane.speed * 3.6) for _, lane in streets], dtype=np.float64)
        self._width = np.array([lane.width for _, lane in streets])
        self._lanes = np.array([len(edge.lanes_of("driving")) for edge, _ in streets], dtype=np.float64)
        self._tree = shapely.STRtree(self._lines)
        self._areas = list(_junctions(self.net))
        self._near = shapely.STRtree([area.buffer(NEAR_M) for _, _, area in self._areas])

    def measure(self, position: Array, yaw: Array) -> dict[str, Column]:
        """Return the scenery at places (F, 2) [m] and directions of travel (F,) [rad], as a column (F,) per concept.

        Units are those of the binding: speed limit [km/h], lane width [m], gradient [%].
        """
        lane = self._match(position, yaw)
        known, row = lane >= 0, np.maximum(lane, 0)
        limit = np.where(known, self._limit[row], np.nan)
        junction = np.full(len(position), -1)
        at, area = self._near.query(shapely.points(position), predicate="within")
        junction[at[::-1]] = area[::-1]
        kinds = np.array([*(kind for kind, _, _ in self._areas), "none"])
        controls = np.array([*(control for _, control, _ in self._areas), "none"])
        spaces = self.town.parameters.parking
        parked = np.zeros(len(position), np.bool_)
        if spaces:
            places = np.array([(space.x, space.y) for space in spaces])
            parked = (np.linalg.norm(position[:, None] - places, axis=2) <= NEAR_M).any(axis=1)
        return {
            "zone": np.where(parked, "parking_lot", ""),
            "drivable_area_type": np.where(parked, "parking", _name_roads(limit)),
            "lanes": np.where(known, self._lanes[row], np.nan),
            "lane_width": np.where(known, self._width[row], np.nan),
            "speed_limit": limit,
            "gradient": self._gradient(position, yaw),
            "driving_side": np.full(len(position), "right" if self.net.side == 1 else "left"),
            "junction": kinds[junction],
            "junction_control": controls[junction],
        }

    def places(self) -> tuple[ScenarioPlace, ...]:
        """Return the places of the town: every junction, then the middle of every straight road."""
        return (*self._junction_places(), *self._straight_places())

    def measure_places(self, places: Sequence[ScenarioPlace]) -> dict[str, Column]:
        """Return the scenery on the approaches of places, with their kinds and controls: a column per concept."""
        columns = self.measure(
            np.array([place.approach for place in places]), np.array([place.yaw for place in places])
        )
        kinds, controls = ([getattr(place, name) for place in places] for name in ("kind", "control"))
        return columns | {"junction": np.array(kinds), "junction_control": np.array(controls)}

    def _match(self, position: Array, yaw: Array) -> NDArray[np.int64]:
        """Return the lane (F,) of each place, -1 for none: the nearest, with a penalty for other directions."""
        points = np.asarray(shapely.points(position), dtype=object)
        at, lane = self._tree.query(points, predicate="dwithin", distance=LANE_M)
        lines, near = self._lines[lane], points[at]
        along = shapely.line_locate_point(lines, near)
        ends = [shapely.line_interpolate_point(lines, np.clip(along + side, 0.0, None)) for side in (-1.0, 1.0)]
        step = shapely.get_coordinates(ends[1]) - shapely.get_coordinates(ends[0])
        turned = 1 - np.cos(np.arctan2(step[:, 1], step[:, 0]) - yaw[at])
        cost = shapely.distance(lines, near) + TURNED * turned
        order = np.lexsort((cost, at))
        first = np.unique(at[order], return_index=True)[1]
        lanes = np.full(len(position), -1)
        lanes[at[order][first]] = lane[order][first]
        return lanes

    def _gradient(self, position: Array, yaw: Array) -> Array:
        """Return the magnitude (F,) of the ground's slope in the direction of travel [%]."""
        step = SLOPE_M * np.column_stack((np.cos(yaw), np.sin(yaw)))
        ahead, behind = (self.town.grounds(*(position + side * step).T) for side in (1, -1))
        return 100 * np.abs(ahead - behind) / (2 * SLOPE_M)

    def _junction_places(self) -> Iterator[ScenarioPlace]:
        conflicts = count_conflicts(self.net)
        for kind, control, area in self._areas:
            middle = area.centroid
            inside = [name for name, node in self.net.junctions.items() if area.covers(Point(node.centre))]
            leads = [
                edge.lanes_of("driving")[0]
                for edge in self.net.streets
                if edge.end in inside and edge.start not in inside and edge.lanes_of("driving")
            ]
            if leads:
                line = LineString(leads[0].shape)
                start, end = _pose_along(line, line.length - BEFORE_M), _pose_along(line, line.length)
                points = sum(conflicts[name] for name in inside)
                yield ScenarioPlace(self.town.name, kind, control, middle.x, middle.y, end[:2], end[2], start, points)

    def _straight_places(self) -> Iterator[ScenarioPlace]:
        for edge in self.net.streets:
            driving = edge.lanes_of("driving")
            line = LineString(driving[0].shape) if driving else None
            if line is None or line.length < 2 * STRAIGHT_M:
                continue
            start, here, end = (_pose_along(line, line.length / 2 + side) for side in (-STRAIGHT_M, 0.0, STRAIGHT_M))
            chord = float(np.hypot(end[0] - start[0], end[1] - start[1]))
            if chord >= BENT * 2 * STRAIGHT_M and not len(self._near.query(Point(here[:2]), predicate="within")):
                yield ScenarioPlace(self.town.name, "none", "none", *here[:2], here[:2], here[2], start, 0)


def _name_roads(limit: Array) -> NDArray[np.str_]:
    """Return the type of road (F,) by its speed limit (F,) [km/h]; "" above the largest, which may be a motorway."""
    out = np.full(len(limit), "", dtype="<U16")
    for most, name in ROADS:
        out[limit <= most] = name
    return out


def _junctions(net: RoadNet) -> Iterator[tuple[str, str, BaseGeometry]]:
    """Yield kind, control and area of the junctions with three or more arms; a roundabout is one junction."""
    arms: dict[str, set[str]] = {}
    for edge in net.streets:
        arms.setdefault(edge.start, set()).add(edge.end)
        arms.setdefault(edge.end, set()).add(edge.start)
    circles = nx.Graph([(edge.start, edge.end) for edge in net.streets
                        if edge.start in net.roundabouts and edge.end in net.roundabouts])  # fmt: skip
    for nodes in nx.connected_components(circles):
        outlines = [_outline(net, name) for name in sorted(nodes)]
        yield "roundabout", "signed", shapely.union_all(outlines).convex_hull
    for name, others in arms.items():
        if len(others) > 2 and name not in net.roundabouts:
            kind = net.junctions[name].kind
            control = next((word for begins, word in CONTROLS.items() if kind.startswith(begins)), "uncontrolled")
            yield ARMS.get(len(others), "other"), control, _outline(net, name)


def _outline(net: RoadNet, name: str) -> BaseGeometry:
    junction = net.junctions[name]
    return (
        Point(junction.centre).buffer(1.0) if len(junction.shape) < 3 else shapely.Polygon(junction.shape).convex_hull
    )


def count_conflicts(net: RoadNet) -> Counter[str]:
    """Return the number of conflict points of vehicles at each junction: where paths diverge, merge and cross."""
    driving = {lane.id: (edge, lane) for edge in net.edges.values() for lane in edge.lanes_of("driving")}
    ways: dict[str, list[LaneConnection]] = {}
    for way in net.connections:
        if way.start in driving and way.end in driving and way.turn != "t":
            edge, _ = driving[way.start]
            if edge.function == "normal":
                ways.setdefault(edge.end, []).append(way)
    onward = {(way.start, way.end): way.via for way in net.connections}
    points: Counter[str] = Counter()
    for junction, through in ways.items():
        for ends in (Counter(way.start for way in through), Counter(way.end for way in through)):
            points[junction] += sum(count - 1 for count in ends.values())
        paths = {way: _path(way, driving, onward) for way in through}
        points[junction] += sum(
            one.start != other.start and one.end != other.end and paths[one].crosses(paths[other])
            for one, other in combinations(through, 2)
        )
    return points


def _path(way: LaneConnection, driving: dict[str, tuple], onward: dict[tuple[str, str], str]) -> LineString:
    """Return the path through a junction, from the end of a lane to the start of another."""
    points = [driving[way.start][1].shape[-1:]]
    via, seen = way.via, set[str]()
    while via in driving and via not in seen:
        seen.add(via)
        points.append(driving[via][1].shape)
        via = onward.get((via, way.end), "")
    return LineString(np.concatenate([*points, driving[way.end][1].shape[:1]]))


def _pose_along(line: LineString, along: float) -> tuple[float, float, float]:
    """Return x, y [m] and direction [rad] at a distance `along` a line [m], limited to its ends."""
    along = min(max(along, 0.0), line.length)
    here = line.interpolate(along)
    behind, ahead = line.interpolate(max(along - 1.0, 0.0)), line.interpolate(min(along + 1.0, line.length))
    return here.x, here.y, float(np.arctan2(ahead.y - behind.y, ahead.x - behind.x))
