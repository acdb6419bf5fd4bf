"""Scripts of corner cases, with actors and their actions, and the player that runs them in a live world.

Actors are kinematic, without physics: they follow the ego vehicle's route where they drive along or against it, and
otherwise a straight line. The same scripts are written as OpenSCENARIO (`odd.openscenario`).
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
LANE_M = 3.4  # between the centre lines of adjacent lanes
ALONG_M = 12.0  # an actor that starts within this distance of the route,
ALONG_RAD = math.pi / 4  # and within this angle of its direction or the opposite, follows it
PREFIX = "script-"  # of the actors' names, to tell them from those of the traffic

Pose = tuple[float, float, float]  # ahead and to the left of the ego's start [m], heading relative to the ego's [rad]


@dataclass(frozen=True)
class Entity:
    """A scripted actor of a scenario."""

    name: str
    category: str
    shape: str
    start: Pose  # relative to the ego's start
    speed: float  # initial [m/s]
    size: tuple[float, float, float] | None = None  # length, width, height [m]; None: that of the shape


@dataclass(frozen=True)
class Speed:
    """A speed change of an actor at a constant rate."""

    actor: str
    target: float  # [m/s]
    rate: float  # magnitude of the acceleration [m/s^2]


@dataclass(frozen=True)
class Aside:
    """A lane change of an actor."""

    actor: str
    lanes: int  # to the left; negative to the right
    within_s: float  # duration


@dataclass(frozen=True)
class Script:
    """Script of a corner case: its actors, and the actions that start together when its trigger fires."""

    actors: tuple[Entity, ...]
    actions: tuple[Speed | Aside, ...]
    near: str | None = None  # trigger by distance: the ego is within `within_m` of this actor; None: by time
    within_m: float = 0.0
    begins_s: float = BEGINS_S  # trigger by time
    origin: Pose | None = None  # world pose of the ego's start [m], [rad]; None: where its route begins


def write_script(case: Kind, limit: float) -> Script:
    """Return the script of a corner case on a street with a speed limit [m/s]."""
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
    """State of an actor: its line, its position on the line, and the actions in progress."""

    entity: Entity
    origin: tuple[float, float, float]  # start of a straight line in the world: x, y [m], yaw [rad]
    along: float | None  # distance along the route [m]; None on a straight line
    left: float  # lateral offset from the line [m], to the actor's left
    way: int  # 1 along the route, -1 against it
    speed: float  # [m/s]
    target: float | None = None  # speed [m/s]
    rate: float = 0.0  # [m/s^2]
    gone: float = 0.0  # distance on a straight line [m]
    shift: tuple[float, float, float, float] | None = None  # lane change: start, duration [s], from, to offset [m]


class ScriptPlayer:
    """Player of scripts: moves their actors in a live world."""

    def __init__(self, world: LiveWorld, scripts: Sequence[Script], route: Route, start_m: float) -> None:
        """Spawn the actors, and remove traffic that is in their place; the ego starts at `start_m` [m] of the route."""
        self._world, self._route = world, route
        self._waiting = list(scripts)
        self._actors = {
            entity.name: self._enter(entity, script.origin, start_m) for script in scripts for entity in script.actors
        }

    def act(self, ego: tuple[float, float], dt_s: float) -> None:
        """Move the actors by a step of `dt_s` [s]; `ego` is the ego vehicle's position x, y [m] in the world."""
        now = self._world.snapshot.time_s
        for script in [waiting for waiting in self._waiting if self._fires(waiting, ego, now)]:
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
        """Return an actor that starts relative to the route: ahead along it, and to its left."""
        ahead, left, turned = entity.start
        x, y, yaw = self._route.at(start_m + ahead).tolist()
        aside = (x, y) + left * left_vectors(yaw)
        place = (float(aside[0]), float(aside[1]), yaw + turned)
        return self._start(entity, place, start_m + ahead, left, turned)

    def _in_world(self, entity: Entity, origin: Pose, start_m: float) -> _Acting:
        """Return an actor that starts relative to a world pose: straight ahead of it, and to its left."""
        ahead, left, turned = entity.start
        x, y = (float(axis) for axis in rotate(ahead, left, origin[2]))
        place = (origin[0] + x, origin[1] + y, origin[2] + turned)
        along, aside = self._route.project(place[0], place[1], start_m + ahead)
        return self._start(entity, place, along, aside, place[2] - float(self._route.at(along)[2]))

    def _start(self, entity: Entity, place: Pose, along: float, left: float, turned: float) -> _Acting:
        """Return an actor that follows the route where it starts nearly parallel to it, otherwise a straight line."""
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
