"""A live world: vehicles and walkers under control, and SUMO's traffic that reacts to them, step by step.

A world starts with a seed, executes commands, and returns immutable snapshots. The same seed, commands and steps give
the same bytes; so a world is forked by repeating its history (`replay`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType, TracebackType
from typing import Self

import numpy as np

from flcav.arrays import Array
from flcav.config import InputError, shorten
from flcav.world import commands
from flcav.world.commands import Command, Controls
from flcav.world.dynamics.bodies import Bodies, ControlledBody
from flcav.world.dynamics.contacts import Contacts, Footprints, find_overlaps, resolve_contacts
from flcav.world.dynamics.obstacles import TownGround, corners, join_footprints, list_obstacles, outline_actors
from flcav.world.dynamics.vehicle import VEHICLES, make_blueprint
from flcav.world.map.town import Town
from flcav.world.scenarios.stage import STEP_S
from flcav.world.snapshot import NOBODY, Actors, Collision, Snapshot, join_actors, pick_actors
from flcav.world.trace import Trace
from flcav.world.traffic.live import WARM_UP_S, SumoTraffic, TrafficLights, read_light_programs, stand_parked

SUBSTEP_S, SUBSTEP_M = 0.05, 2.0  # longest time and distance of a substep, in which no body tunnels through a box
LONGEST_S = 10.0  # longest step
NEAR_M = 2.0  # margin around bodies within which obstacles are tested
RESERVED = ("veh", "ped", "parked")  # prefixes of the names of other actors
FARTHEST = 1e7  # greatest coordinate [m] and speed [m/s]
NOTHING: Mapping[str, Controls] = MappingProxyType({})


class Obstructed(InputError):
    """An actor cannot be spawned because its place is occupied."""


@dataclass(frozen=True)
class Settings:
    """Initial conditions and settings of a live world, in addition to its town."""

    seed: int = 0
    traffic: int = 0  # number of SUMO's vehicles; with neither vehicles nor pedestrians, SUMO is not started
    pedestrians: int = 0  # number of SUMO's pedestrians
    parked: bool = True  # with the vehicles parked along the streets
    dt_s: float = 0.05  # length of a step [s]
    leans: bool = False  # controlled cars pitch and roll on their springs
    remembers: bool = True  # it keeps its history, which grows with every step and command


DEFAULT = Settings()


@dataclass(frozen=True)
class LiveStep:
    """A step in the history of a live world."""

    dt_s: float  # [s]


class LiveWorld:
    """A simulated town that advances in steps; a context manager, since it may own a SUMO process.

    >>> from flcav import load_town
    >>> from flcav.world.commands import Controls, Spawn
    >>> with LiveWorld(load_town("suburb")) as world:
    ...     world.apply(Spawn("ego", "car", 3, 0.0, 0.0, anywhere=True))
    ...     snapshot = world.step({"ego": Controls(throttle=1.0)})
    >>> snapshot.time_s
    0.05
    """

    def __init__(self, town: Town, settings: Settings = DEFAULT) -> None:
        """Start at time 0, after a warm-up of SUMO's traffic.

        Raises `InputError` for invalid settings, `RuntimeError` where SUMO fails.
        """
        _check_step(settings.dt_s)
        if min(settings.traffic, settings.pedestrians) < 0:
            raise InputError(f"traffic = {settings.traffic}, pedestrians = {settings.pedestrians}: must be 0 or more")
        self.town = town
        self.settings = settings
        self.history: list[Command | LiveStep] = []
        self.lights = TrafficLights(read_light_programs(town.net), WARM_UP_S)
        self.bodies = Bodies(ground := TownGround(town), leans=settings.leans)
        self._ground = ground
        self._parked = stand_parked(town, ground, settings.seed) if settings.parked else NOBODY
        self.obstacles = list_obstacles(town, self._parked)
        self._time_s, self._number = 0.0, 0
        self._collisions: tuple[Collision, ...] = ()
        self._hit: set[str] = set()  # since the last step of SUMO
        self._flow = NOBODY  # SUMO's actors
        self._traffic: SumoTraffic | None = None
        self._snapshot: Snapshot | None = None
        if settings.traffic or settings.pedestrians:
            self._traffic = SumoTraffic(
                town, ground, seed=settings.seed, vehicles=settings.traffic, pedestrians=settings.pedestrians
            )
            self._flow = self._traffic.at(0.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End SUMO; a world with traffic cannot be stepped any more."""
        if self._traffic is not None:
            self._traffic.close()

    @property
    def snapshot(self) -> Snapshot:
        """The present state of the world."""
        if self._snapshot is None:
            self._snapshot = self._build_snapshot()
        return self._snapshot

    def step(self, controls: Mapping[str, Controls] = NOTHING, *, dt_s: float | None = None) -> Snapshot:
        """Advance the world by one step of `dt_s` [s], by default that of the settings; return its new state.

        Vehicles without new `controls` keep their last ones. Raises `InputError` for unknown vehicles and an invalid
        `dt_s`, `RuntimeError` where SUMO fails.
        """
        dt_s = self.settings.dt_s if dt_s is None else dt_s
        _check_step(dt_s)
        for name, wanted in controls.items():
            if self.bodies.find(name).controls != wanted:
                self.apply(commands.Drive(name, wanted))
        self._note(LiveStep(dt_s))
        begins = self._time_s
        velocity = self.bodies.velocity.copy()
        collisions: dict[tuple[str, str], Collision] = {}
        fastest = float(np.abs(velocity).max(initial=0.0))
        parts = math.ceil(max(dt_s / SUBSTEP_S, dt_s * fastest / SUBSTEP_M) - 1e-9)
        for part in range(1, parts + 1):
            self._time_s = round(begins + dt_s * part / parts, 9)
            self.lights.advance(dt_s / parts)
            self._advance_traffic()
            self._move(dt_s / parts, collisions)
        self.bodies.acceleration = (self.bodies.velocity - velocity) / dt_s
        self._number += 1
        self._collisions = tuple(collisions.values())
        self._snapshot = None
        return self.snapshot

    def apply(self, command: Command) -> None:
        """Execute a command. Raises `InputError` where that is not possible, without changing anything."""
        bodies = self.bodies
        match command:
            case commands.Spawn():
                self._spawn(command)
            case commands.Remove(name):
                if self._traffic is not None and name in self._flow.name:
                    self._traffic.remove(name)
                    self._flow = self._traffic.at(self._time_s)
                else:
                    bodies.remove(bodies.row(name))
            case commands.Drive(name, controls):
                _check_numbers(controls.throttle, controls.steer, controls.brake)
                _check_category(body := bodies.find(name), VEHICLES, "vehicle")
                body.controls = controls
            case commands.Grip(name, share):
                if not 0 <= share <= 1:
                    raise InputError(f"share = {share}: must be within 0 and 1")
                _check_category(body := bodies.find(name), VEHICLES, "vehicle")
                body.grip = share
            case commands.Walk(name, velocity):
                _check_numbers(*velocity)
                _check_category(body := bodies.find(name), ("pedestrian",), "walker")
                body.walk = velocity
            case commands.Place(name, x, y, yaw, z, pitch, roll):
                _check_numbers(x, y, yaw, z or 0.0, pitch, roll)
                bodies.place(bodies.row(name), x, y, yaw, z, pitch, roll)
            case commands.Push(name, velocity, yaw_rate):
                row = bodies.row(name)
                _check_numbers(*velocity, yaw_rate or 0.0)
                bodies.push(row, velocity)
                bodies.yaw_rate[row] = bodies.yaw_rate[row] if yaw_rate is None else yaw_rate
            case commands.Simulate(name, physics, gravity):
                body = bodies.find(name)
                body.physics, body.gravity = physics, gravity
                bodies.land(bodies.row(name))
            case commands.SetLight(junction, state):
                self.lights.set(junction, state)
            case commands.FreezeLights(frozen):
                self.lights.frozen = frozen
        self._note(command)
        self._snapshot = None

    def find_obstruction(self, command: commands.Spawn) -> str | None:
        """Return the name of an object in the place of an actor to be spawned, as in `Collision`.

        None if it is free.
        """
        probe = Bodies(self._ground)
        probe.add(
            ControlledBody(command.name, make_blueprint(command.category, command.shape, command.size)), *_pose(command)
        )
        box = outline_actors(probe.actors())
        others, names = self._list_boxes(self.bodies.actors(), *corners(box))
        overlaps = find_overlaps(box, others)
        return names[overlaps[0, 1]] if len(overlaps) else None

    def height(self, x: float, y: float, z: float | None = None) -> float:
        """Return the height of the ground [m] at x, y [m], world frame, or of a bridge that is nearer to `z` [m]."""
        return float(self._ground.heights(np.array([x]), np.array([y]), np.array([np.nan if z is None else z]))[0])

    def _note(self, entry: Command | LiveStep) -> None:
        if self.settings.remembers:
            self.history.append(entry)

    def _spawn(self, command: commands.Spawn) -> None:
        name = command.name
        made = make_blueprint(command.category, command.shape, command.size)
        if not name or name.startswith(RESERVED):
            raise InputError(f"name {shorten(name)}: must not be empty, nor begin with {', '.join(RESERVED)}")
        if any(body.name == name for body in self.bodies.members):
            raise InputError(f"name {shorten(name)}: another actor has it")
        _check_numbers(command.x, command.y, command.yaw, command.z or 0.0)
        if not command.anywhere and (other := self.find_obstruction(command)):
            raise Obstructed(f"actor {shorten(name)}: '{other}' is in its place")
        self.bodies.add(ControlledBody(name, made), *_pose(command))

    def _advance_traffic(self) -> None:
        """Advance SUMO to the present time, and interpolate its actors."""
        if self._traffic is None:
            return
        while self._traffic.ticks * STEP_S < self._time_s - 1e-6:
            grounded = pick_actors(self.bodies.actors(), self.bodies.find_grounded())
            self._traffic.advance(grounded, self.lights.states(), sorted(self._hit))
            self._hit.clear()
        self._flow = self._traffic.at(self._time_s)

    def _move(self, dt_s: float, found: dict[tuple[str, str], Collision]) -> None:
        """Move the bodies by `dt_s` [s] and resolve their contacts; add the collisions to `found`."""
        bodies = self.bodies
        if not (count := len(bodies.members)):
            return
        before = bodies.actors().places
        bodies.move(dt_s)
        now = bodies.actors()
        boxes, names = self._list_boxes(now, *corners(outline_actors(now)))
        mass, inertia = (np.concatenate((values, np.full(len(names) - count, np.inf))) for values in bodies.weights())
        flow = slice(count, count + len(self._flow.name))
        velocity, yaw_rate = np.zeros((len(names), 2)), np.zeros(len(names))
        velocity[:count], yaw_rate[:count] = now.velocity[:, :2], now.yaw_rate
        velocity[flow], yaw_rate[flow] = self._flow.velocity[:, :2], self._flow.yaw_rate
        start = np.concatenate((before, boxes.place[count:]))
        place, velocity, yaw_rate, contacts = resolve_contacts(boxes, start, velocity, yaw_rate, mass, inertia)
        bodies.fall(velocity[:count] - now.velocity[:, :2])
        bodies.position[:, :2], bodies.yaw = place[:count, :2], place[:count, 2]
        bodies.velocity[:, :2], bodies.yaw_rate = velocity[:count], yaw_rate[:count]
        bodies.settle(dt_s)
        self._report(contacts, names, found)
        self._hit.update(names[row] for row in contacts.second.tolist() if flow.start <= row < flow.stop)

    def _list_boxes(self, actors: Actors, low: Array, high: Array) -> tuple[Footprints, list[str]]:
        """Return the boxes of the bodies, of SUMO's actors and of obstacles near rectangles, and their names."""
        near = self.obstacles.near(low - NEAR_M, high + NEAR_M)
        obstacles = Footprints(*(array[near] for array in self.obstacles.boxes))
        boxes = join_footprints(outline_actors(actors), outline_actors(self._flow), obstacles)
        return boxes, [*actors.name, *self._flow.name, *(self.obstacles.name[row] for row in near.tolist())]

    def _report(self, contacts: Contacts, names: Sequence[str], found: dict[tuple[str, str], Collision]) -> None:
        """Add the contacts to the collisions `found` during a step: impulses of the same pair are summed."""
        impulses = contacts.impulse[:, None] * contacts.normal
        for row in range(len(impulses)):
            pair = names[int(contacts.first[row])], names[int(contacts.second[row])]
            known = found[pair].impulse if pair in found else (0.0, 0.0)
            x, y = impulses[row].tolist()
            at_x, at_y = contacts.point[row].tolist()
            found[pair] = Collision(*pair, (known[0] + x, known[1] + y), (at_x, at_y))

    def _build_snapshot(self) -> Snapshot:
        actors = join_actors(self.bodies.actors(), self._flow, self._parked)
        lights = self.lights.states()
        trace = Trace(
            town=self.town.name,
            time_s=np.array([self._time_s]),
            actor=np.array(actors.name, np.str_),
            category=np.array(actors.category, np.str_),
            shape=actors.shape,
            size=actors.size,
            present=np.ones((1, len(actors.name)), np.bool_),
            position=actors.position[None],
            yaw=actors.yaw[None],
            velocity=actors.velocity[None],
            acceleration=actors.acceleration[None],
            yaw_rate=actors.yaw_rate[None],
            light=np.array([f"{name}:{i}" for name, state in lights.items() for i in range(len(state))], np.str_),
            light_state=np.array(list("".join(lights.values())), "<U1").reshape(1, -1),
            tilt=actors.tilt[None] if actors.tilt.any() else None,
        )
        controls = {body.name: body.controls for body in self.bodies.members if body.category in VEHICLES}
        return Snapshot(self._number, self._time_s, trace, MappingProxyType(controls), self._collisions)


def replay(town: Town, settings: Settings, history: Sequence[Command | LiveStep]) -> LiveWorld:
    """Return a fork of a world: a new one with its settings in which its history is repeated."""
    world = LiveWorld(town, settings)
    try:
        for entry in history:
            if isinstance(entry, LiveStep):
                world.step(dt_s=entry.dt_s)
            else:
                world.apply(entry)
    except BaseException:
        world.close()
        raise
    return world


def _pose(command: commands.Spawn) -> tuple[float, float, float, float | None]:
    return command.x, command.y, command.yaw, command.z


def _check_step(dt_s: float) -> None:
    if not 0 < dt_s <= LONGEST_S:
        raise InputError(f"dt_s = {dt_s}: must be above 0, and at most {LONGEST_S} s")


def _check_numbers(*values: float) -> None:
    for value in values:
        if not abs(value) <= FARTHEST:
            raise InputError(f"{value}: must be a number of at most {FARTHEST:g}")


def _check_category(body: ControlledBody, categories: Sequence[str], word: str) -> None:
    if body.category not in categories:
        raise InputError(f"actor {shorten(body.name)}: is no {word}, but a {body.category}")
