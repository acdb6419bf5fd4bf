"""An episode: one map with its live world and actors, until the next map is loaded.

In every tick the world makes a step; then all actors take their new poses, and the sensors measure.
"""

import time
from functools import cached_property

import numpy as np

from flcav.carla.frames import from_mount, mirror, mirror_spin, to_vector
from flcav.carla.server import wire
from flcav.carla.server.actors import (
    STANDING,
    WAITING,
    Counters,
    ServedActor,
    list_grips,
    list_places,
    steer_towards,
)
from flcav.carla.server.blueprints import (
    TRUE,
    CallRefused,
    CarlaBlueprint,
    Quality,
    check_description,
    list_blueprints,
    read_paint,
)
from flcav.carla.server.lights import LightActors, find_approaches, find_limits, list_signals, list_signs
from flcav.carla.server.maps import ServedMap
from flcav.carla.server.recorder import Recorder
from flcav.carla.server.sensors import SensorClock, sense_depth, sense_instance, sense_rgb
from flcav.carla.server.sight import Scenes, Sensor
from flcav.carla.server.streams import PARKED, Streams
from flcav.carla.server.streams import Measurement as Measurement
from flcav.carla.server.wire import Transform
from flcav.geometry import Array
from flcav.sensors.rendering.appearance import build_appearance
from flcav.world import commands
from flcav.world.commands import Controls, Drive, Push, Remove, Simulate, Spawn, Walk
from flcav.world.live import LiveWorld, Obstructed, Settings
from flcav.world.snapshot import Snapshot

TRAFFIC_OF = {  # category -> blueprint of SUMO's traffic for clients
    "car": "vehicle.seat.leon",
    "van": "vehicle.mercedes.sprinter",
    "truck": "vehicle.carlamotors.carlacola",
    "bus": "vehicle.mitsubishi.fusorosa",
    "motorcycle": "vehicle.yamaha.yzf",
    "bicycle": "vehicle.gazelle.omafiets",
    "pedestrian": "walker.pedestrian.0001",
}
UNGUIDED_S = 0.5  # a walker that its AI has not placed for so long stops


class Episode(Streams):
    """One map with its live world and actors, until the next map is loaded."""

    def __init__(
        self,
        served: ServedMap,
        counters: Counters,
        *,
        seed: int,
        traffic: int,
        port: int,
        quality: Quality = Quality.HIGH,
    ) -> None:
        """Start the world of a map; `port` is the streams' port, which is part of sensors' tokens."""
        self.served, self.counters, self.seed, self.port = served, counters, seed, port
        self._quality = quality
        counters.episode += 1
        self.id = counters.episode
        self.stream = counters.next_stream()  # of the world's state
        self.world = LiveWorld(served.town, Settings(seed=seed, traffic=traffic, leans=True, remembers=False))
        self.weather = wire.WeatherParameters(cloudiness=10.0, sun_azimuth_angle=160.0, sun_altitude_angle=45.0)
        signals = list_signals(served)
        self.lights, self.signs = LightActors(find_approaches(served, signals)), find_limits(signals)
        self.actors: dict[int, ServedActor] = {}
        self.tick, self.time_s = 0, 0.0
        self._begun_s = time.monotonic()
        self._bodies: dict[str, ServedActor] = {}  # by name in the live world
        self._scenes = Scenes(served.town)
        self.recorder = Recorder()
        self._spawned = 0
        self.spectator = self._add(wire.Description(0, "spectator", ()), np.eye(4))
        centre = np.mean(np.reshape(served.town.bounds, (2, 2)), axis=0)
        self.place(
            self.spectator, Transform(to_vector(served.frame.to_location(np.append(centre, 60.0))), (-60.0, 0.0, 0.0))
        )
        for row, approach in enumerate(self.lights.approaches):
            light = self._add(wire.Description(0, "traffic.traffic_light", ()), approach.pose)
            light.light, light.box = row, approach.box()
        for placed in list_signs(served, signals):
            sign = self._add(wire.Description(0, placed.blueprint, ()), placed.pose)
            sign.sign, sign.box = placed.id, placed.box
        self.lights.follow(self.world, 0.0)
        self._follow(self.world.snapshot, 0.0)

    def warm_up(self) -> None:
        """Compile the code of vehicle dynamics, so that no client waits for it."""
        with LiveWorld(self.served.town, Settings(parked=False)) as world:
            world.apply(Spawn("car", "car", 0, *self.spectator.pose[:2, 3].tolist(), anywhere=True))
            world.step({"car": Controls(throttle=1.0)})

    def prepare(self) -> None:
        """Build the scenes of the sensors, and compile the code of cameras, so that no client waits for them.

        It may run concurrently with ticks, since it renders in a separate scene.
        """
        for scene in ("images", "rays"):
            build_appearance(self.look(scene)().scene)
        attributes = {"image_size_x": "32", "image_size_y": "32", "fov": "90"}
        camera, look = Sensor("sensor.camera.depth", attributes, 0, self.spectator.pose), self.look("first")
        for sense in (sense_depth, sense_instance, sense_rgb):
            sense(look(), camera)
        self.served.keep()

    @property
    def age_s(self) -> float:
        """The wall-clock time since the map was loaded [s]."""
        return time.monotonic() - self._begun_s

    @cached_property
    def spawn_points(self) -> list[Transform]:
        """Poses at which there is room for every vehicle in the empty town."""
        return self.served.list_spawn_points(self.world.obstacles.boxes)

    def close(self) -> None:
        """Close the world, and write the recording."""
        self.recorder.stop()
        self.world.close()

    # ---- actors

    def find(self, number: int, *kinds: str) -> ServedActor:
        """Return the actor with an id. Raises `CallRefused` for an unknown id or an actor of another kind."""
        actor = self.actors.get(number)
        if actor is None:
            raise CallRefused(f"actor {number} not found")
        if kinds and actor.kind not in kinds:
            raise CallRefused(f"actor {number} is no {' or '.join(kinds)}, but a {actor.description.id}")
        return actor

    def spawn(self, description: wire.Description, transform: Transform, parent: int | None = None) -> ServedActor:
        """Spawn an actor, attached to `parent` if given. Raises `CallRefused` if it is invalid or obstructed."""
        blueprint, description = check_description(description, self._quality)
        carrier = self.find(parent) if parent else None
        if carrier is not None:
            pose = carrier.pose @ from_mount(*transform)
        else:
            pose = self.served.frame.from_transform(*transform)
        if blueprint.category:
            return self._spawn_body(blueprint, description, pose, parent or 0)
        if blueprint.kind == "controller" and (carrier is None or carrier.kind != "walker"):
            raise CallRefused(f"{description.id} needs a walker as its parent")
        actor = self._add(description, pose)
        if carrier is None:
            actor.transform = transform
        else:
            actor.parent, actor.mount = carrier.id, from_mount(*transform)
        if blueprint.kind == "sensor":
            values = {attribute.id: attribute.value for attribute in description.attributes}
            name = carrier.name if carrier is not None else ""
            actor.sensor = Sensor(description.id, values, self._spawned, pose, name)
            actor.clock = SensorClock(float(values.get("sensor_tick", 0.0)))
            actor.stream = self.counters.next_stream()
        return actor

    def _add(self, description: wire.Description, pose: Array) -> ServedActor:
        self._spawned += 1
        transform = Transform(*self.served.frame.to_transform(pose))
        actor = ServedActor(self.counters.next_actor(), description, transform, pose)
        self.actors[actor.id] = actor
        return actor

    def _spawn_body(
        self, blueprint: CarlaBlueprint, description: wire.Description, pose: Array, parent: int
    ) -> ServedActor:
        x, y, z = pose[:3, 3].tolist()
        lift = blueprint.size[2] / 2 if blueprint.category == "pedestrian" else 0.0
        name = f"c{self._spawned + 1}"
        yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
        command = Spawn(name, blueprint.category, blueprint.shape, x, y, yaw, z - lift, blueprint.size)
        try:
            self.world.apply(command)
        except Obstructed:
            raise CallRefused("Spawn failed because of collision at spawn position") from None
        actor = self._add(description, pose)
        actor.name, actor.category, actor.size = name, blueprint.category, blueprint.size
        actor.parent, actor.paint = parent, read_paint(description)
        actor.sticky = all(
            attribute.id != "sticky_control" or attribute.value.lower() in TRUE for attribute in description.attributes
        )
        self._bodies[name] = actor
        snapshot = self.world.snapshot
        row = snapshot.row(name)
        actor.take(list_places(snapshot, self.served.frame, row + 1)[row])
        return actor

    def destroy(self, actor: ServedActor) -> None:
        """Remove an actor; attached sensors stay where they are."""
        if actor is self.spectator or actor.kind == "traffic":
            raise CallRefused(f"actor {actor.id} is a {actor.description.id} of the town, which cannot be destroyed")
        del self.actors[actor.id]
        if actor.name:
            del self._bodies[actor.name]
            self.world.apply(Remove(actor.name))
        for child in self.actors.values():
            if child.parent == actor.id:
                child.parent, child.mount = 0, None

    def is_own(self, actor: ServedActor) -> bool:
        """Return whether a client spawned the actor's body."""
        return actor.name.startswith("c")

    def body(self, number: int, *kinds: str) -> ServedActor:
        """Return an actor with a body, and let clients move it from now on. Raises `CallRefused` as `find` does."""
        actor = self.find(number, *kinds)
        self._take_over(actor)
        return actor

    def _take_over(self, actor: ServedActor) -> None:
        """Turn an actor of SUMO's traffic into a controlled body, with unchanged pose and velocity."""
        if not actor.name or self.is_own(actor):
            return
        snapshot = self.world.snapshot
        trace = snapshot.trace
        row = snapshot.row(actor.name)
        (x, y, z), velocity = trace.position[0, row].tolist(), trace.velocity[0, row]
        yaw, (length, width, height) = float(trace.yaw[0, row]), trace.size[row].tolist()
        shape, size = int(trace.shape[row]), (length, width, height)
        self.world.apply(Remove(actor.name))
        del self._bodies[actor.name]
        self._spawned += 1
        actor.name = f"c{self._spawned}"
        self._bodies[actor.name] = actor
        self.world.apply(Spawn(actor.name, actor.category, shape, x, y, yaw, z, size, anywhere=True))
        self.push(actor, velocity)

    # ---- motion

    def place(self, actor: ServedActor, transform: Transform) -> None:
        """Move an actor to a transform, which is relative to the parent if it is attached."""
        self._take_over(actor)
        pose = self.served.frame.from_transform(*transform)
        if actor.parent and actor.mount is not None:
            actor.mount = from_mount(*transform)
            actor.pose = self.actors[actor.parent].pose @ actor.mount
            actor.transform = Transform(*self.served.frame.to_transform(actor.pose))
        else:
            actor.pose, actor.transform = pose, transform
        if actor.sensor is not None:
            actor.sensor.pose = actor.pose
        if self.is_own(actor):
            x, y, z = actor.pose[:3, 3].tolist()
            pitch, yaw, roll = np.radians(transform.rotation).tolist()
            self.world.apply(commands.Place(actor.name, x, y, -yaw, z - actor.lift, -pitch, roll))

    def drive(self, actor: ServedActor, control: wire.VehicleControl) -> None:
        """Set a vehicle's throttle, brakes, steering and gear."""
        actor.control, actor.told = control, True
        self.world.apply(
            Drive(
                actor.name,
                Controls(
                    throttle=min(max(control.throttle, 0.0), 1.0),
                    steer=-min(max(control.steer, -1.0), 1.0),
                    brake=min(max(control.brake, 0.0), 1.0),
                    hand_brake=control.hand_brake,
                    reverse=control.reverse or (control.manual and control.gear < 0),
                ),
            )
        )

    def walk(self, actor: ServedActor, control: wire.WalkerControl) -> None:
        """Set a walker's direction and speed; this switches on its physics if its AI has switched them off."""
        if not actor.simulated:
            self.simulate(actor, physics=True)
        actor.walk = control
        x, y, _ = mirror(np.array(control.direction)) * control.speed
        self.world.apply(Walk(actor.name, (float(x), float(y))))
        if control.speed > 0 and (x or y):
            self._turn(actor, float(np.arctan2(y, x)))

    def _turn(self, actor: ServedActor, yaw: float) -> None:
        x, y, z = actor.pose[:3, 3].tolist()
        self.world.apply(commands.Place(actor.name, x, y, yaw, z - actor.lift))

    def motion(self, actor: ServedActor) -> tuple[Array, float]:
        """Return the current velocity (3,) [m/s], world frame, and yaw rate [rad/s] of an actor with a body."""
        bodies = self.world.bodies
        row = bodies.row(actor.name)
        return bodies.velocity[row].copy(), float(bodies.yaw_rate[row])

    def push(self, actor: ServedActor, velocity: Array, yaw_rate: float | None = None) -> None:
        """Set the velocity (3,) [m/s], world frame, and the yaw rate [rad/s], None: unchanged, of an actor."""
        x, y, z = velocity.tolist()
        self.world.apply(Push(actor.name, (x, y, z), yaw_rate))

    def simulate(self, actor: ServedActor, *, physics: bool | None = None, gravity: bool | None = None) -> None:
        """Switch an actor's physics or gravity on or off; None keeps it."""
        actor.simulated = actor.simulated if physics is None else physics
        actor.falling = actor.falling if gravity is None else gravity
        self.world.apply(Simulate(actor.name, actor.simulated, actor.falling))

    # ---- ticks

    def step(self, dt_s: float) -> None:
        """Advance the world by one tick of `dt_s` [s]."""
        for actor in self._bodies.values():
            if actor.constant is not None:
                self.push(actor, actor.pose[:3, :3] @ actor.constant)
            if not actor.simulated and actor.walk.speed and self.time_s > actor.guided_s + UNGUIDED_S:
                actor.walk = WAITING
                self.push(actor, np.zeros(3))
            if not actor.sticky and not actor.told:
                actor.ackermann = None
                self.drive(actor, STANDING)
            if actor.ackermann is not None:
                limit, _ = self.steering(actor)
                self.drive(actor, steer_towards(actor.ackermann, actor.control, self.speed(actor), limit, dt_s))
            actor.told = False
        for command in list_grips(self.actors.values(), self.world.bodies.members):
            self.world.apply(command)
        snapshot = self.world.step(dt_s=dt_s)
        self.tick += 1
        self.counters.frame += 1
        self.time_s += dt_s
        self.lights.follow(self.world, dt_s)
        self._follow(snapshot, dt_s)
        for actor in self._bodies.values():
            if actor.kind == "vehicle" and (limit := self.signs.find_passed(actor.pose)) is not None:
                actor.limit_kmh = limit
        self.recorder.add(snapshot)

    def steering(self, actor: ServedActor) -> tuple[float, float]:
        """Return the greatest steering angle [rad] and the wheelbase [m] of a vehicle."""
        made = self.world.bodies.find(actor.name).blueprint
        return made.steer_limit_rad, made.wheelbase_m

    def _follow(self, snapshot: Snapshot, dt_s: float) -> None:
        """Update the poses and motions of all actors, and the set of SUMO's actors, from a snapshot."""
        names = [name for name in snapshot.trace.actor.tolist() if not name.startswith(PARKED)]
        places = list_places(snapshot, self.served.frame, len(names))
        for row, name in enumerate(names):
            actor = self._bodies.get(name) or self._meet(snapshot, row)
            actor.take(places[row])
        if len(self._bodies) > len(names):
            for name in set(self._bodies) - set(names):
                del self.actors[self._bodies.pop(name).id]
        for actor in self.actors.values():
            if actor.mount is not None and not actor.name:
                carrier = self.actors[actor.parent]
                actor.pose = carrier.pose @ actor.mount
                actor.transform = Transform(*self.served.frame.to_transform(actor.pose))
                actor.motion = carrier.motion
                if actor.sensor is not None:
                    velocity, spin, acceleration = (np.array(part) for part in carrier.motion)
                    actor.sensor.pose, actor.sensor.velocity = actor.pose, mirror(velocity)
                    actor.sensor.spin, actor.sensor.acceleration = mirror_spin(np.radians(spin)), mirror(acceleration)

    def _meet(self, snapshot: Snapshot, row: int) -> ServedActor:
        """Add the actor of a vehicle or pedestrian of SUMO that has entered the town."""
        category = str(snapshot.trace.category[row])
        blueprint = list_blueprints()[TRAFFIC_OF[category]]
        attributes = tuple(
            wire.Attribute(attribute.id, attribute.type, attribute.value)
            for attribute in blueprint.definition.attributes
        )
        attributes = tuple(
            attribute._replace(value="traffic") if attribute.id == "role_name" else attribute
            for attribute in attributes
        )
        actor = self._add(wire.Description(blueprint.definition.uid, blueprint.definition.id, attributes), np.eye(4))
        actor.name, actor.category = str(snapshot.trace.actor[row]), category
        length, width, height = snapshot.trace.size[row].tolist()
        actor.size = (length, width, height)
        self._bodies[actor.name] = actor
        return actor
