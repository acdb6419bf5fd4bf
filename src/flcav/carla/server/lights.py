"""Traffic lights as CARLA's actors, one per approach to a signalised junction, and traffic signs with speed limits.

A light that a client sets keeps its state for the time of that state; then its junction returns to its program.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Point

from flcav.carla.frames import mirror
from flcav.carla.server.maps import ServedMap
from flcav.carla.server.wire import BoundingBox
from flcav.geometry import Array, heading_vectors, inverse, pose, wrap_angle
from flcav.world.commands import SetLight
from flcav.world.live import LiveWorld
from flcav.world.map.roads import Edge, Lane
from flcav.world.opendrive.document import STOP_SIGN, drop_namespaces
from flcav.world.opendrive.exporting import TRAFFIC_LIGHT, list_approaches, name_signal
from flcav.world.opendrive.objects.signs import read_limit
from flcav.world.opendrive.reference_line import ReferenceLine

RED, YELLOW, GREEN, OFF, UNKNOWN = 0, 1, 2, 3, 4
LETTERS_OF = {GREEN: "Gg", YELLOW: "yYu", RED: "rRs", OFF: "oO"}
STATES = {letter: state for state, letters in LETTERS_OF.items() for letter in letters}
TIMES_S = (10.0, 3.0, 2.0)  # CARLA's times of green, yellow and red
BEFORE_M, BEYOND_M = 8.0, 1.0  # a vehicle is at a light if its front is within this of the stop line
ALIGNED_RAD = 1.0  # largest difference of a vehicle's heading from the direction of a sign or light
SIGNS = {"205": "traffic.yield", STOP_SIGN: "traffic.stop"}  # by type in CARLA's maps, which use Germany's sign numbers
LANE_M = 3.5  # width of a sign's trigger volume
PASSED_M, BESIDE_M = 10.0, 12.0  # a vehicle has just passed a sign within these longitudinal and lateral distances


class MapSignal(NamedTuple):
    """A signal of an OpenDRIVE map: a traffic light or sign, in world coordinates."""

    id: str
    row: ElementTree.Element  # of the map
    place: Array  # (3,) x, y [m], and the heading of its road [rad]
    entries: Array  # (K, 2) x, y [m] of references to it, at the beginning of the lanes that it controls


def list_signals(served: ServedMap) -> list[MapSignal]:
    """Return the signals of a map."""
    signals: list[tuple[ElementTree.Element, Array]] = []
    entries: dict[str, list[Array]] = {}
    text = served.opendrive.encode("utf-8", "surrogateescape")
    root = ElementTree.fromstring(text[max(text.find(b"<?xml "), 0) :])  # comments may stand before the declaration
    drop_namespaces(root)
    for road in root.iterfind("road"):
        if not (rows := road.findall("signals/*")):
            continue
        line = ReferenceLine(road)
        for row in rows:
            x, y, heading = line.at(np.array([float(row.get("s", "0"))]))[0]
            t, (dx, dy) = float(row.get("t", "0")), served.frame.offset_m
            at = np.array((x - t * np.sin(heading) + dx, y + t * np.cos(heading) + dy, heading))
            if row.tag == "signal":
                signals.append((row, at))
            elif row.tag == "signalReference":
                entries.setdefault(row.get("id", ""), []).append(at[:2])
    map_signals = []
    for row, at in signals:
        name = row.get("id", "")
        map_signals.append(MapSignal(name, row, at, np.array(entries.get(name, [])).reshape(-1, 2)))
    return map_signals


@dataclass(frozen=True)
class Approach:
    """An approach to a signalised junction: the lanes of one edge. World frame."""

    junction: str
    link: str  # "junction:link" of its representative signal
    links: tuple[int, ...]  # indices of all its links in the junction's state string
    sign: str  # id of its signal in the map
    pose: Array  # (4, 4) world from actor [m]; the x axis points across the road
    stop: Array  # (3,) middle of the stop line: x, y [m], and driving direction [rad]
    half_width: float  # of its lanes [m]

    def box(self) -> BoundingBox:
        """Return the light's trigger volume before the stop line, in the actor frame."""
        return _box_before(self.stop, self.half_width, self.pose)


def _box_before(line: Array, half_width: float, pose: Array) -> BoundingBox:
    """Return the trigger volume before a line, x, y [m] and driving direction [rad], in the actor frame at `pose`."""
    middle = np.append(line[:2] - 3.0 * heading_vectors(line[2]), pose[2, 3] + 1.0)
    x, y, z = mirror((inverse(pose) @ np.append(middle, 1.0))[:3]).tolist()
    return BoundingBox((x, y, z), (half_width, 2.5, 1.5))


def find_approaches(served: ServedMap, signals: Sequence[MapSignal]) -> list[Approach]:
    """Return the approaches to all traffic lights of a map, in the net's order; `signals` are those of the map."""
    imported = served.town.parameters.source is not None  # towns of flcav name their lights by their links
    mapped = [signal for signal in signals if imported and signal.row.get("type") == TRAFFIC_LIGHT]
    net = served.net
    lights = served.town.signals
    place = {link: row for row, link in reversed(list(enumerate(lights.link)))}
    approaches = []
    for name, link in list_approaches(net).items():
        edge = net.edges[name]
        x, y, heading, half_width = _find_stop(edge)
        lanes = {lane.id for lane in edge.lanes}
        ruled = {way.light for way in net.connections if way.light and way.start in lanes}
        foot = lights.foot[place[link]] if link in place else (x, y)
        head = lights.position[place[link], :2] if link in place else np.array((x, y))
        sign = min(mapped, key=partial(_measure_off, head, np.array((x, y)))).id if mapped else name_signal(link)
        ground = served.town.ground(float(foot[0]), float(foot[1]))
        approaches.append(
            Approach(
                junction=link.rpartition(":")[0],
                link=link,
                links=tuple(sorted(int(controlled.rpartition(":")[2]) for controlled in ruled)),
                sign=sign,
                pose=pose(float(foot[0]), float(foot[1]), ground, heading - np.pi / 2),
                stop=np.array((x, y, heading)),
                half_width=half_width,
            )
        )
    return approaches


def _find_stop(edge: Edge) -> tuple[float, float, float, float]:
    """Return the middle of an edge's stop line x, y [m], the driving direction [rad], and half its width [m]."""
    lanes = edge.lanes_of("driving")
    ends = np.array([lane.shape[-1] for lane in lanes])
    ahead = lanes[0].shape[-1] - lanes[0].shape[-2]
    x, y = ends.mean(axis=0)
    return float(x), float(y), float(np.arctan2(ahead[1], ahead[0])), sum(lane.width for lane in lanes) / 2


def _measure_off(head: Array, stop: Array, signal: MapSignal) -> float:
    """Return the distance of a signal from a light [m]: of its entries from the stop line, or of itself from the head.

    The heads may hang beyond the junction, next to another stop line.
    """
    return float(
        np.hypot(*(signal.entries - stop).T).min() if len(signal.entries) else np.hypot(*(signal.place[:2] - head))
    )


@dataclass(frozen=True)
class SpeedLimits:
    """The N speed-limit signs of a map, world frame."""

    place: Array  # (N, 3) x, y [m], and driving direction that the sign applies to [rad]
    kmh: Array  # (N,) limits [km/h]

    def find_passed(self, pose: Array) -> float | None:
        """Return the limit [km/h] of the sign that a vehicle at `pose` (4, 4) [m] has just passed, if any."""
        if not len(self.kmh):
            return None
        off = pose[:2, 3] - self.place[:, :2]
        ahead = heading_vectors(self.place[:, 2])
        along, across = (off * ahead).sum(axis=1), ahead[:, 0] * off[:, 1] - ahead[:, 1] * off[:, 0]
        facing = ahead @ pose[:2, 0] > np.cos(ALIGNED_RAD)
        passed = np.flatnonzero((along >= 0) & (along < PASSED_M) & (np.abs(across) < BESIDE_M) & facing)
        return float(self.kmh[passed[along[passed].argmin()]]) if len(passed) else None


def find_limits(signals: Sequence[MapSignal]) -> SpeedLimits:
    """Return the speed-limit signs among a map's signals; a sign for both directions is listed twice."""
    place, kmh = [np.zeros((0, 3))], []
    for _, row, at, _ in signals:
        if (limit := read_limit(row)) is None:
            continue
        turns = _list_turns(row)
        place += [at[None] + (0.0, 0.0, turn) for turn in turns]
        kmh += [3.6 * limit] * len(turns)
    return SpeedLimits(np.concatenate(place), np.round(np.array(kmh, np.float64), 1))


def _list_turns(signal: ElementTree.Element) -> tuple[float, ...]:
    """Return the driving directions that a signal applies to, relative to the road's [rad]."""
    return {"+": (0.0,), "-": (np.pi,)}.get(signal.get("orientation", "none"), (0.0, np.pi))


@dataclass(frozen=True)
class Sign:
    """A traffic sign that is an actor in CARLA."""

    blueprint: str
    id: str  # in the map
    pose: Array  # (4, 4) world from actor [m]; the x axis points across the road
    box: BoundingBox  # trigger volume, actor frame


def list_signs(served: ServedMap, signals: Sequence[MapSignal]) -> list[Sign]:
    """Return the stop, yield and speed-limit signs among a map's signals, in its order."""
    lanes = [lane for edge in served.net.streets for lane in edge.lanes_of("driving")]
    lines = shapely.STRtree([LineString(lane.shape) for lane in lanes])
    signs = []
    for name, signal, at, entries in signals:
        limit, kind = read_limit(signal), SIGNS.get(signal.get("type", ""))
        blueprint = kind if limit is None else f"traffic.speed_limit.{3.6 * limit:.0f}"
        if blueprint is None or not lanes:
            continue
        heading = at[2] + _list_turns(signal)[0]
        place = pose(at[0], at[1], served.town.ground(at[0], at[1]), heading - np.pi / 2)
        here = entries[0] if len(entries) else at[:2]
        spots = [_project(lanes[row], here) for row in lines.query(Point(here), "dwithin", BESIDE_M).tolist()]
        ahead = [spot for spot in spots if len(entries) or abs(wrap_angle(spot[2] - heading)) < ALIGNED_RAD]
        line = min(ahead, key=lambda spot: float(np.hypot(*(spot[:2] - here))), default=np.append(here, heading))
        signs.append(Sign(blueprint, name, place, _box_before(line, LANE_M / 2, place)))
    return signs


def _project(lane: Lane, place: Array) -> Array:
    """Project a point on a lane's centre line: (3,) x, y [m], and driving direction [rad]."""
    line = LineString(lane.shape)
    along = min(line.project(Point(place)), line.length - 0.1)
    here, there = (np.array(line.interpolate(at).coords[0]) for at in (along, along + 0.1))
    return np.append(here, np.arctan2(*(there - here)[::-1]))


@dataclass
class LightActors:
    """The traffic lights of a live world, as clients see and set them."""

    approaches: list[Approach]
    state: list[int] = field(default_factory=list)  # per approach
    elapsed_s: list[float] = field(default_factory=list)  # time in that state, per approach [s]
    times_s: list[list[float]] = field(default_factory=list)  # times of green, yellow and red, per approach [s]
    frozen: bool = False
    _held: dict[str, dict[int, tuple[int, float]]] = field(default_factory=dict)  # junction -> row -> state, until [s]

    def __post_init__(self) -> None:
        self.state = [UNKNOWN] * len(self.approaches)
        self.elapsed_s = [0.0] * len(self.approaches)
        self.times_s = [list(TIMES_S) for _ in self.approaches]

    def follow(self, world: LiveWorld, dt_s: float) -> None:
        """Read the states from the world after a step of `dt_s` [s], and release junctions whose set times are over."""
        for junction in [name for name, rows in self._held.items() if not self.frozen and self._is_over(rows, world)]:
            del self._held[junction]
            world.apply(SetLight(junction, None))
        letters = world.lights.states()
        for row, approach in enumerate(self.approaches):
            number = int(approach.link.rpartition(":")[2])
            state = STATES.get(letters[approach.junction][number], UNKNOWN)
            self.elapsed_s[row] = self.elapsed_s[row] + dt_s if state == self.state[row] else 0.0
            self.state[row] = state

    @staticmethod
    def _is_over(rows: dict[int, tuple[int, float]], world: LiveWorld) -> bool:
        return all(until <= world.snapshot.time_s for _, until in rows.values())

    def set_state(self, world: LiveWorld, row: int, state: int) -> None:
        """Set the state of the approach in a row, for the time of that state."""
        approach = self.approaches[row]
        held = self._held.setdefault(approach.junction, {})
        green, yellow, red = self.times_s[row]
        held[row] = (state, world.snapshot.time_s + {GREEN: green, YELLOW: yellow}.get(state, red))
        letters = list(world.lights.states()[approach.junction])
        for other, (shown, _) in held.items():
            for link in self.approaches[other].links:
                letters[link] = LETTERS_OF.get(shown, "O")[0]
        world.apply(SetLight(approach.junction, "".join(letters)))
        self.state[row], self.elapsed_s[row] = state, 0.0

    def release(self, world: LiveWorld, junction: str | None = None) -> None:
        """Return a junction, or all junctions, to its program."""
        for name in [junction] if junction is not None else list(self._held):
            if self._held.pop(name, None) is not None:
                world.apply(SetLight(name, None))

    def group(self, row: int) -> Iterator[int]:
        """Yield the rows of the approaches to the same junction."""
        junction = self.approaches[row].junction
        return (other for other, approach in enumerate(self.approaches) if approach.junction == junction)

    def find_at(self, fronts: Array, yaw: Array) -> NDArray[np.int64]:
        """Return (N,) the approaches at whose lights vehicles are; -1: none.

        `fronts` (N, 2) [m] are the middles of the vehicles' fronts, `yaw` (N,) [rad] their headings, world frame.
        """
        if not self.approaches or not len(fronts):
            return np.full(len(fronts), -1)
        stop = np.array([approach.stop for approach in self.approaches])
        half = np.array([approach.half_width for approach in self.approaches])
        off = fronts[:, None] - stop[None, :, :2]
        cos, sin = np.cos(stop[:, 2]), np.sin(stop[:, 2])
        along, across = off[..., 0] * cos + off[..., 1] * sin, off[..., 1] * cos - off[..., 0] * sin
        at = (along > -BEFORE_M) & (along < BEYOND_M) & (np.abs(across) < half)
        at &= np.abs(wrap_angle(yaw[:, None] - stop[:, 2])) < ALIGNED_RAD
        return np.where(at.any(axis=1), at.argmax(axis=1), -1)
