"""Scripts of corner cases: what actors beside the ego vehicle do, and the player that lets them do it in a live world.

Actors are kinematic: they keep to a line, that of the ego vehicle's route where they drive along it or against it, and
otherwise a straight one, and nothing moves them. The same scripts are written as OpenSCENARIO (`odd.openscenario`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from flcav.geometry import heading_vectors, left_vectors, rotate, wrap_angle
from flcav.world.commands import Place, Push, Remove, Simulate, Spawn
from flcav.world.live import LiveWorld
from flcav.world.map.roads import Route
from flcav.world.scenarios.scenario import Kind
from flcav.world.shapes import SHAPES

BEGINS_S = 2.0
LANE_M = 3.4  # from a lane's middle to that of the next
ALONG_M, ALONG_RAD = 12.0, math.pi / 4  # an actor so near to the route, and so nearly parallel, keeps along it
PREFIX = "script-"  # of the names of actors: those of the traffic begin otherwise

Pose = tuple[float, float, float]  # ahead of and left of the ego's start [m], heading to the ego's [rad]


@dataclass(frozen=True)
class Entity:
    """An entity of a scenario beside the ego."""

    name: str
    category: str
    shape: str
    start: Pose
    speed: float  # [m/s]
    size: tuple[float, float, float] | None = None  # length, width, height [m]; None: that of the shape


@dataclass(frozen=True)
class Speed:
    """An actor goes over to a speed [m/s] at a rate [m/s^2]."""

    actor: str
    target: float
    rate: float


@dataclass(frozen=True)
class Aside:
    """A lane change of an actor: the number of lanes to the left, and the duration."""

    actor: str
    lanes: int
    within_s: float


@dataclass(frozen=True)
class Script:
    """What happens in a corner case: actors, and actions that begin together when the trigger fires."""

    actors: tuple[Entity, ...]
    actions: tuple[Speed | Aside, ...]
    near: str | None = None  # fires when the ego is within `within_m` of this actor; None: at `begins_s`
    within_m: float = 0.0
    begins_s: float = BEGINS_S
    origin: Pose | None = None  # world pose of the ego's start; None: where its route begins


def write_script(case: Kind, limit: float) -> Script:
    """Return the script of a corner case on a street with that speed limit [m/s]."""
    back = math.pi
    if case == "stalled_vehicle":
        return Script((Entity("stalled", "car", "sedan", (25.0, 0.0, 0.0), limit),), (Speed("stalled", 0.0, 4.0),))
    if case == "crash":
        ahead, behind = (Entity(f"car_{n}", "car", "sedan", (at, 0.0, 0.0), limit) for n, at in ((1, 38.0), (2, 28.0)))
        return Script((ahead, behind), (Speed("car_1", 0.0, 9.0),))
    if case == "cut_in":
        car = Entity("neighbour", "car", "hatchback", (8.0, LANE_M, 0.0), 0.9 * limit)
        return Script((car,), (Aside("neighbour", -1, 2.2),))
    if case == "overtaking":
        slow = Entity("slow", "truck", "box_truck", (70.0, LANE_M, back), 0.5 * limit)
        fast = Entity("overtaking", "car", "sedan", (85.0, LANE_M, back), limit)
        return Script((slow, fast), (Aside("overtaking", 1, 2.5), Speed("overtaking", 1.2 * limit, 2.0)))
    if case == "pedestrian_behind_van":
        van = Entity("van", "van", "high_van", (24.0, -2.6, 0.0), 0.0)
        walker = Entity("walker", "pedestrian", "child", (28.5, -3.2, math.pi / 2), 0.0)
        return Script((van, walker), (Speed("walker", 2.6, 4.0),), near="walker", within_m=22.0)
    runner = Entity("runner", "car", "hatchback", (48.0, -35.0, math.pi / 2), 9.0)
    return Script((runner,), (Speed("runner", 12.0, 2.0),), near="runner", within_m=45.0)


@dataclass
class _Acting:
    """An actor under way: its line, where it is on it, and what it goes over to."""

    entity: Entity
    origin: tuple[float, float, float]  # x, y [m], yaw [rad] of a straight line
    along: float | None  # the route [m]; None on a straight line
    left: float  # of the line [m], to the actor's own left
    way: int  # 1 along the route, -1 against it
    speed: float
    target: float | None = None
    rate: float = 0.0
    gone: float = 0.0  # on a straight line [m]
    shift: tuple[float, float, float, float] | None = None  # begins [s], lasts [s], from, to [m]


class ScriptPlayer:
    """The actors of scripts in a live world."""

    def __init__(self, world: LiveWorld, scripts: Sequence[Script], route: Route, start_m: float) -> None:
        """Put the actors in their places; vehicles of the traffic that are there leave."""
        self._world, self._route, self._waiting = world, route, list(scripts)
        self._actors = {
            each.name: self._enter(each, script.origin, start_m) for script in scripts for each in script.actors
        }

    def act(self, ego: tuple[float, float], dt_s: float) -> None:
        """Let the actors go on for `dt_s` [s], when the ego vehicle is at x, y [m]."""
        now = self._world.snapshot.time_s
        for script in [each for each in self._waiting if self._fires(each, ego, now)]:
            self._waiting.remove(script)
            for action in script.actions:
                self._begin(action, now)
        for actor in self._actors.values():
            self._move(actor, now, dt_s)

    def _enter(self, entity: Entity, origin: Pose | None, start_m: float) -> _Acting:
        actor = self._on_route(entity, start_m) if origin is None else self._in_world(entity, origin, start_m)
        names = [shape.name for shape in SHAPES[entity.category]]
        x, y, yaw = self._pose(actor)
        name = PREFIX + entity.name
        spawn = Spawn(name, entity.category, names.index(entity.shape), x, y, yaw, size=entity.size, anywhere=True)
        while (other := self._world.find_obstruction(spawn)) is not None and other.startswith(("veh", "ped")):
            self._world.apply(Remove(other))
        self._world.apply(spawn)
        self._world.apply(Simulate(name, physics=False))
        return actor

    def _on_route(self, entity: Entity, start_m: float) -> _Acting:
        """Return an actor whose place is ahead along the route, and to its left."""
        ahead, left, turned = entity.start
        x, y, yaw = self._route.at(start_m + ahead).tolist()
        aside = (x, y) + left * left_vectors(yaw)
        place = (float(aside[0]), float(aside[1]), yaw + turned)
        return self._start(entity, place, start_m + ahead, left, turned)

    def _in_world(self, entity: Entity, origin: Pose, start_m: float) -> _Acting:
        """Return an actor whose place is ahead and to the left of a pose in the world."""
        ahead, left, turned = entity.start
        x, y = (float(each) for each in rotate(ahead, left, origin[2]))
        place = (origin[0] + x, origin[1] + y, origin[2] + turned)
        along, aside = self._route.project(place[0], place[1], start_m + ahead)
        return self._start(entity, place, along, aside, place[2] - float(self._route.at(along)[2]))

    def _start(self, entity: Entity, place: Pose, along: float, left: float, turned: float) -> _Acting:
        """Return an actor on the route's line where it goes along it, and otherwise on a straight one."""
        angle = abs(float(wrap_angle(turned)))
        parallel = abs(left) < ALONG_M and min(angle, math.pi - angle) < ALONG_RAD
        if not parallel or entity.category == "pedestrian" or not 0 < along < self._route.length_m:
            return _Acting(entity, place, None, 0.0, 1, entity.speed)
        way = 1 if angle < math.pi / 2 else -1
        return _Acting(entity, place, along, way * left, way, entity.speed)

    def _fires(self, script: Script, ego: tuple[float, float], now: float) -> bool:
        if script.near is None:
            return now >= script.begins_s
        x, y, _ = self._pose(self._actors[script.near])
        return math.hypot(x - ego[0], y - ego[1]) < script.within_m

    def _begin(self, action: Speed | Aside, now: float) -> None:
        actor = self._actors[action.actor]
        if isinstance(action, Speed):
            actor.target, actor.rate = action.target, action.rate
        else:
            actor.shift = (now, action.within_s, actor.left, actor.left + action.lanes * LANE_M)

    def _move(self, actor: _Acting, now: float, dt_s: float) -> None:
        before = actor.speed
        if actor.target is not None:
            step = max(-actor.rate * dt_s, min(actor.rate * dt_s, actor.target - actor.speed))
            actor.speed += step
        if actor.shift is not None:
            begins, lasts, first, last = actor.shift
            share = min((now - begins) / lasts, 1.0)
            actor.left = first + (last - first) * share**2 * (3 - 2 * share)
        gone = (before + actor.speed) / 2 * dt_s
        actor.gone += gone
        if actor.along is not None:
            actor.along += actor.way * gone
        x, y, yaw = self._pose(actor)
        ahead = heading_vectors(yaw) * actor.speed
        name = PREFIX + actor.entity.name
        self._world.apply(Place(name, x, y, yaw))
        self._world.apply(Push(name, (float(ahead[0]), float(ahead[1]), 0.0)))

    def _pose(self, actor: _Acting) -> tuple[float, float, float]:
        if actor.along is None:
            x, y, yaw = actor.origin
            place = (x, y) + actor.gone * heading_vectors(yaw) + actor.left * left_vectors(yaw)
        else:
            x, y, yaw = self._route.at(actor.along).tolist()
            place = (x, y) + actor.way * actor.left * left_vectors(yaw)
            yaw = yaw if actor.way > 0 else float(wrap_angle(yaw + math.pi))
        return float(place[0]), float(place[1]), yaw
