"""The streams of an episode: the state of its world in every tick, and what its sensors measure."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from flcav.carla.frames import mirror
from flcav.carla.server import wire
from flcav.carla.server.actors import Counters, ServedActor, choose_gear
from flcav.carla.server.lights import LightActors
from flcav.carla.server.maps import ServedMap
from flcav.carla.server.sensors import KINDS, describe_thing, find_collisions, find_obstacle
from flcav.carla.server.sight import Scenes, Sensor, TownSight
from flcav.carla.server.weather import to_weather
from flcav.carla.server.wire import Transform
from flcav.world.live import LiveWorld
from flcav.world.scene import Scene
from flcav.world.trace import Trace

PARKED = "parked"  # prefix of the names of parked vehicles, which are not actors for clients
NOWHERE = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class Measurement(NamedTuple):
    """A message of a sensor at one tick."""

    stream: int  # id
    header: bytes
    body: bytes | Callable[[], bytes]  # or a function that measures it
    rays: bool = False  # measured by ray casting
    late: bool = False  # measured asynchronously: ticks do not wait for it


class Streams:
    """The streams of an episode: ticks and sensor data to the clients; `Episode` moves its world and its actors."""

    id: int
    seed: int
    port: int  # of the streams, which is part of sensors' tokens
    served: ServedMap
    world: LiveWorld
    weather: wire.WeatherParameters
    counters: Counters
    lights: LightActors
    spectator: ServedActor
    actors: dict[int, ServedActor]  # by id
    tick: int
    time_s: float
    _bodies: dict[str, ServedActor]  # by name in the live world
    _scenes: Scenes

    def describe_world(self, dt_s: float) -> bytes:
        """Return the payload of the world state."""
        header = wire.pack_header(wire.Stream.WORLD, self.counters.frame, self.time_s, NOWHERE)
        vehicles = [actor for actor in self.actors.values() if actor.kind == "vehicle"]
        states = dict(zip((actor.id for actor in vehicles), self._find_lights(vehicles)))
        rows = [
            wire.pack_actor(actor.id, actor.transform, actor.motion, self._union(actor, states))
            for actor in self.actors.values()
        ]
        return header + wire.pack_world(self.id, time.time(), dt_s, rows)

    def _find_lights(self, vehicles: list[ServedActor]) -> list[int]:
        """Return the rows of the traffic lights at which vehicles are; -1: none."""
        if not vehicles:
            return []
        poses = np.array([actor.pose for actor in vehicles])
        half = np.array([actor.size[0] / 2 for actor in vehicles])
        fronts = poses[:, :2, 3] + half[:, None] * poses[:, :2, 0]
        yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
        return self.lights.find_at(fronts, yaw).tolist()

    def _union(self, actor: ServedActor, states: dict[int, int]) -> bytes:
        if actor.kind == "vehicle":
            row = states[actor.id]
            light = self.lights.state[row] if row >= 0 else 2
            number = self.light_number(row) if row >= 0 else 0
            gear = choose_gear(actor.control, self.speed(actor))
            return wire.pack_vehicle(actor.control, gear, actor.limit_kmh, light, row >= 0, number)
        if actor.kind == "walker":
            return wire.pack_walker(actor.walk)
        if actor.sign:
            return wire.pack_sign(actor.sign)
        if (row := actor.light) is not None:
            green, yellow, red = self.lights.times_s[row]
            sign = self.lights.approaches[row].sign
            elapsed = self.lights.elapsed_s[row]
            return wire.pack_light(sign, (green, yellow, red), elapsed, 0, self.lights.frozen, self.lights.state[row])
        return b""

    def speed(self, actor: ServedActor) -> float:
        """Return the speed of an actor along its heading [m/s]."""
        return float(mirror(np.array(actor.motion[0])) @ actor.pose[:3, 0])

    def light_number(self, row: int) -> int:
        """Return the actor id of an approach's traffic light; the lights' ids follow the spectator's."""
        return self.spectator.id + 1 + row

    def measure(self, dt_s: float, is_heard: Callable[[int], bool]) -> Iterator[Measurement]:
        """Yield the messages of all sensors that are due and subscribed to, in the order of their spawning."""
        looks: dict[str, Callable[[], TownSight]] = {}
        collisions = find_collisions(self.world.snapshot.collisions, self._describe)
        for actor in list(self.actors.values()):
            if (sensor := actor.sensor) is None or actor.clock is None or not is_heard(actor.stream):
                continue
            kind = KINDS[sensor.type]
            header = wire.pack_header(kind.stream, self.counters.frame, self.time_s, actor.transform)
            if kind.stream == wire.Stream.COLLISION:
                for body in collisions.get(sensor.carrier, []):
                    yield Measurement(actor.stream, header, body)
            if kind.measure is None and kind.stream != wire.Stream.OBSTACLE:
                continue
            if (elapsed := actor.clock.take(self.time_s, dt_s)) is None:
                continue
            sensor.elapsed_s = elapsed
            scene = "images" if kind.late else "rays"
            look = looks.get(scene) or looks.setdefault(scene, self.look(scene))
            if kind.measure is not None:
                seen_from = replace(sensor) if kind.late else sensor  # an image is drawn while its sensor moves on
                body = partial(_measure, kind.measure, look, seen_from)
                yield Measurement(actor.stream, header, body, kind.rays, kind.late)
            elif found := find_obstacle(look(), sensor, self._describe(sensor.carrier), self._describe):
                yield Measurement(actor.stream, header, found)

    def _describe(self, name: str) -> wire.ActorRecord:
        """Return the record of an actor or of an object of the town, such as "building:3", by name in the world."""
        if name in self._bodies:
            return self._bodies[name].record(self.port)
        return describe_thing("vehicle" if name.startswith(PARKED) else name.partition(":")[0])

    def look(self, scene: str) -> Callable[[], TownSight]:
        """Return a function that renders the town's present state in the named scene; it may be called later."""
        trace, weather, tick = self.world.snapshot.trace, to_weather(self.weather), self.tick
        numbers = [self._bodies[name].id if name in self._bodies else 0 for name in trace.actor.tolist()]

        @cache
        def sight() -> TownSight:
            at = self._follow_with(scene, trace)
            return TownSight(at, weather, self.served.frame, self.seed, tick, np.array(numbers, np.uint32))

        return sight

    def survey(self) -> Scene:
        """Return the present scene for calls; it is separate, since sensors may be rendering in theirs."""
        return self._follow_with("calls", self.world.snapshot.trace)

    def _follow_with(self, name: str, trace: Trace) -> Scene:
        paints = {
            name_in_world: actor.paint for name_in_world, actor in list(self._bodies.items()) if actor.paint is not None
        }
        return self._scenes.follow(name, trace, paints)


def _measure(sense: Callable[[TownSight, Sensor], bytes], look: Callable[[], TownSight], sensor: Sensor) -> bytes:
    return sense(look(), sensor)
