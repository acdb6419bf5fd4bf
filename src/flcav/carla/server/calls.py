"""The remote procedure calls of CARLA 0.9.16's clients.

A method of `Calls` handles the call of the same name: its annotations are the types on the wire, and its result is the
value of the reply. A `CallRefused` becomes the reply's error. Vectors are in CARLA's left-handed frame.
"""

from collections.abc import Callable
from functools import lru_cache
from hashlib import sha256
from typing import Any, get_type_hints

import numpy as np

from flcav.carla.frames import mirror, mirror_spin, to_vector
from flcav.carla.server import wire
from flcav.carla.server.actors import NOTHING, Counters, ServedActor, describe_physics, describe_telemetry
from flcav.carla.server.blueprints import CallRefused, Quality, list_blueprints
from flcav.carla.server.episode import Episode
from flcav.carla.server.maps import Maps
from flcav.carla.server.scenery import find_boxes, list_scenery, project_ray
from flcav.carla.server.wire import BoundingBox, Transform, Vector
from flcav.config import InputError, shorten
from flcav.world.commands import FreezeLights

DEFAULT_DT_S = 0.05  # of a tick where the client sets none
DT_RANGE_S = (0.001, 10.0)
BODIES = ("vehicle", "walker", "static")
TIMES = {"green": 0, "yellow": 1, "red": 2}


class Calls:
    """The calls that a server handles, with its settings and its episode."""

    def __init__(
        self, maps: Maps, name: str, *, seed: int, traffic: int, port: int, quality: Quality = Quality.HIGH
    ) -> None:
        """Load the first map. Raises `InputError` for an unknown name."""
        self.maps, self._seed, self._traffic, self._port = maps, seed, traffic, port
        self._quality = quality
        self._counters = Counters()
        self._managers: dict[int, tuple[str, int]] = {}  # Traffic Managers of clients, by port
        self.settings = wire.EpisodeSettings()
        self.ticks = 0  # tick cues that are still to be executed
        self.expected: set[int] = set()  # ids of streams that a client is about to subscribe to
        self.episode = self._start(name)

    def _start(self, name: str) -> Episode:
        served = self.maps.load(name)
        return Episode(
            served,
            self._counters,
            seed=self._seed,
            traffic=self._traffic,
            port=self._port + 1,
            quality=self._quality,
        )

    @property
    def dt_s(self) -> float:
        """The length of a tick [s]."""
        return DEFAULT_DT_S if self.settings.fixed_dt_s is None else self.settings.fixed_dt_s

    @property
    def managed(self) -> bool:
        """Whether a client has registered a Traffic Manager."""
        return bool(self._managers)

    # ---- connection

    def version(self) -> str:
        """Return the served version of CARLA."""
        return wire.VERSION

    def get_episode_info(self) -> wire.Packed:
        """Return the episode's id and the token of the stream of world states."""
        return [self.episode.id, [wire.pack_token(self.episode.stream, self._port + 1)]]

    def get_sensor_token(self, stream: int) -> wire.Packed:
        """Return the token of a sensor's stream."""
        streams = {actor.stream for actor in self.episode.actors.values()} | {self.episode.stream}
        if stream not in streams:
            raise CallRefused(f"no sensor sends on stream {shorten(str(stream))}")
        self.expected.add(stream)
        return [wire.pack_token(stream, self._port + 1)]

    def get_map_info(self) -> wire.Packed:
        """Return the map's name and spawn points."""
        return [f"Carla/Maps/{self.episode.served.name}", self.episode.spawn_points]

    def get_map_data(self) -> str:
        """Return the map as OpenDRIVE text."""
        return self.episode.served.opendrive

    def get_required_files(self, folder: str, download: wire.Packed = None) -> wire.Packed:
        """Return the files of a folder that a client should download: for "Nav" the navigation mesh."""
        return [self._mesh_name()] if folder == "Nav" and self.episode.served.mesh else []

    def request_file(self, name: str) -> bytes:
        """Return the content of a required file."""
        if name != self._mesh_name():
            raise CallRefused(f"no file {shorten(name)} on this server")
        return self.episode.served.mesh

    def _mesh_name(self) -> str:
        """Return the mesh's file name in the clients' cache, which contains a hash of the mesh."""
        served = self.episode.served
        return f"Nav/{served.name}-{sha256(served.mesh).hexdigest()[:16]}.bin"

    def get_navigation_mesh(self) -> bytes:
        """Return the navigation mesh of the client's walkers."""
        return self.episode.served.mesh

    def get_available_maps(self) -> wire.Packed:
        """Return the names of the maps."""
        return [f"/Game/Carla/Maps/{name}" for name in self.maps.names()]

    def load_new_episode(self, name: str, reset: bool, layers: int) -> None:
        """Load a map; an empty name reloads the current one."""
        wanted = name.rpartition("/")[2] or self.episode.served.name
        try:
            episode = self._start(wanted)
        except InputError as error:
            raise CallRefused(str(error)) from None
        self.episode.close()
        self.episode, self.ticks = episode, 0
        if reset:
            self.settings = wire.EpisodeSettings()

    def copy_opendrive_to_file(self, text: str, parameters: wire.Packed) -> None:
        """Receive the OpenDRIVE text of the map that is loaded next."""
        try:
            self.maps.receive(text)
        except InputError as error:
            raise CallRefused(f"this OpenDRIVE map cannot be driven: {error}") from None

    def load_map_layer(self, layers: int) -> None:
        """Show map layers: no effect, all are always shown."""

    def unload_map_layer(self, layers: int) -> None:
        """Hide map layers: no effect, all are always shown."""

    def get_episode_settings(self) -> wire.Packed:
        """Return the episode settings."""
        return self.settings.packed()

    def set_episode_settings(self, settings: wire.EpisodeSettings) -> int:
        """Change the episode settings; return the current frame number."""
        low, high = DT_RANGE_S
        if settings.fixed_dt_s is not None and settings.fixed_dt_s and not low <= settings.fixed_dt_s <= high:
            raise CallRefused(f"fixed_delta_seconds = {settings.fixed_dt_s:g}: must be within {low} and {high}")
        self.settings = settings._replace(fixed_dt_s=settings.fixed_dt_s or None)
        return self._counters.frame

    def tick_cue(self) -> int:
        """Request a tick; return the frame number that it leads to."""
        self.ticks += 1
        return self._counters.frame + self.ticks

    # ---- actors

    def get_actor_definitions(self) -> wire.Packed:
        """Return all blueprints."""
        return [blueprint.definition for blueprint in list_blueprints(self._quality).values()]

    def get_spectator(self) -> wire.Packed:
        """Return the spectator."""
        return self._record(self.episode.spectator)

    def get_actors_by_id(self, numbers: tuple[int, ...]) -> wire.Packed:
        """Return the records of actors by id; destroyed ones are left out."""
        known = self.episode.actors
        return [self._record(known[number]) for number in numbers if number in known]

    def _record(self, actor: ServedActor) -> wire.ActorRecord:
        return actor.record(self._port + 1)

    def spawn_actor(self, description: wire.Description, transform: Transform) -> wire.Packed:
        """Spawn an actor; return its record."""
        return self._record(self.episode.spawn(description, transform))

    def spawn_actor_with_parent(
        self,
        description: wire.Description,
        transform: Transform,
        parent: int,
        attachment: int,
        socket: wire.Packed = "",
    ) -> wire.Packed:
        """Spawn an actor attached to another one; the attachment is always rigid."""
        return self._record(self.episode.spawn(description, transform, parent))

    def destroy_actor(self, actor: int) -> bool:
        """Destroy an actor."""
        self.episode.destroy(self.episode.find(actor))
        return True

    def set_actor_location(self, actor: int, location: Vector) -> None:
        """Set an actor's location [m], keeping its rotation."""
        found = self.episode.find(actor)
        self.episode.place(found, found.transform._replace(location=location))

    def set_actor_transform(self, actor: int, transform: Transform) -> None:
        """Set an actor's transform."""
        self.episode.place(self.episode.find(actor), transform)

    def set_walker_state(self, actor: int, transform: Transform, speed: float) -> None:
        """Set the transform and speed [m/s] of a walker; the location is that of its feet, moved onto the ground."""
        walker = self.episode.body(actor, "walker")
        east, north, height = self.episode.served.frame.from_location(transform.location).tolist()
        x, y, z = transform.location
        z += self.episode.world.height(east, north, height) - height + walker.lift
        self.episode.place(walker, Transform((x, y, z), transform.rotation))
        self.episode.push(walker, speed * walker.pose[:3, 0])
        ahead = mirror(walker.pose[:3, 0])
        walker.walk = wire.WalkerControl((float(ahead[0]), float(ahead[1]), 0.0), speed)
        walker.guided_s = self.episode.time_s

    def set_actor_target_velocity(self, actor: int, velocity: Vector) -> None:
        """Set an actor's velocity [m/s]."""
        self.episode.push(self.episode.body(actor, *BODIES), mirror(np.array(velocity)))

    def set_actor_target_angular_velocity(self, actor: int, rate: Vector) -> None:
        """Set an actor's yaw rate: the vertical component of the angular velocity `rate` [deg/s]."""
        self._turn(self.episode.body(actor, *BODIES), float(mirror_spin(np.radians(rate))[2]))

    def enable_actor_constant_velocity(self, actor: int, velocity: Vector) -> None:
        """Keep a vehicle's velocity [m/s], in the vehicle frame, constant."""
        self.episode.body(actor, "vehicle").constant = mirror(np.array(velocity))

    def disable_actor_constant_velocity(self, actor: int) -> None:
        """Return a vehicle to its controls."""
        self.episode.body(actor, "vehicle").constant = None

    def add_actor_impulse(self, actor: int, impulse: Vector) -> None:
        """Apply an impulse [N s] to an actor."""
        body = self.episode.body(actor, *BODIES)
        velocity, _ = self.episode.motion(body)
        self.episode.push(body, velocity + mirror(np.array(impulse)) / self._mass(body))

    def add_actor_force(self, actor: int, force: Vector) -> None:
        """Apply a force [N] to an actor for one tick."""
        x, y, z = force
        self.add_actor_impulse(actor, (x * self.dt_s, y * self.dt_s, z * self.dt_s))

    def add_actor_impulse_at_location(self, actor: int, impulse: Vector, location: Vector) -> None:
        """Apply an impulse [N s] at the centre of the actor, whatever the location."""
        self.add_actor_impulse(actor, impulse)

    def add_actor_force_at_location(self, actor: int, force: Vector, location: Vector) -> None:
        """Apply a force [N] at the centre of the actor, whatever the location."""
        self.add_actor_force(actor, force)

    def add_actor_angular_impulse(self, actor: int, impulse: Vector) -> None:
        """Apply the vertical component of an angular impulse [N m s] to an actor."""
        body = self.episode.body(actor, *BODIES)
        inertia = self.episode.world.bodies.find(body.name).blueprint.inertia_kgm2
        _, rate = self.episode.motion(body)
        self._turn(body, rate + float(mirror_spin(np.array(impulse))[2]) / inertia)

    def add_actor_torque(self, actor: int, torque: Vector) -> None:
        """Apply the vertical component of a torque [N m] to an actor for one tick."""
        x, y, z = torque
        self.add_actor_angular_impulse(actor, (x * self.dt_s, y * self.dt_s, z * self.dt_s))

    def _turn(self, body: ServedActor, yaw_rate: float) -> None:
        velocity, _ = self.episode.motion(body)
        self.episode.push(body, velocity, yaw_rate)

    def _mass(self, body: ServedActor) -> float:
        return self.episode.world.bodies.find(body.name).blueprint.mass_kg

    def set_actor_simulate_physics(self, actor: int, on: bool) -> None:
        """Switch an actor's physics on or off."""
        self.episode.simulate(self.episode.body(actor, *BODIES), physics=on)

    def set_actor_enable_gravity(self, actor: int, on: bool) -> None:
        """Switch an actor's gravity on or off."""
        self.episode.simulate(self.episode.body(actor, *BODIES), gravity=on)

    def set_actor_collisions(self, actor: int, on: bool) -> None:
        """Switch collisions on; off is refused, except for walkers, whose AI requests it: they keep colliding."""
        if not on and self.episode.find(actor).kind != "walker":
            raise CallRefused("set_collisions(False) is not served: actors always collide")

    def set_actor_dead(self, actor: int) -> None:
        """Stop an actor permanently."""
        self.episode.simulate(self.episode.body(actor, *BODIES), physics=False)

    def set_actor_autopilot(self, actor: int, on: bool, port: wire.Packed = None) -> None:
        """Accept that a client's Traffic Manager drives a vehicle."""
        self.episode.find(actor, "vehicle", "walker")

    def get_actor_bounding_box(self, actor: int) -> BoundingBox:
        """Return an actor's bounding box; an empty one if it is destroyed, since Traffic Managers still ask for it."""
        found = self.episode.actors.get(actor)
        return BoundingBox(NOTHING, NOTHING) if found is None else found.bounding_box()

    def get_actor_component_names(self, actor: int) -> wire.Packed:
        """Return the names of an actor's components: none."""
        self.episode.find(actor)
        return []

    get_actor_bone_names = get_actor_socket_names = get_actor_component_names
    get_actor_bone_world_transforms = get_actor_bone_relative_transforms = get_actor_component_names
    get_actor_socket_world_transforms = get_actor_socket_relative_transforms = get_actor_component_names

    # ---- vehicles and walkers

    def apply_control_to_vehicle(self, actor: int, control: wire.VehicleControl) -> None:
        """Set a vehicle's control."""
        vehicle = self.episode.body(actor, "vehicle")
        vehicle.ackermann = None
        self.episode.drive(vehicle, control)

    def apply_ackermann_control_to_vehicle(self, actor: int, control: wire.AckermannControl) -> None:
        """Set a vehicle's Ackermann control."""
        self.episode.body(actor, "vehicle").ackermann = control

    def get_ackermann_controller_settings(self, actor: int) -> wire.Packed:
        """Return the gains of CARLA's Ackermann controller."""
        self.episode.find(actor, "vehicle")
        return [0.15, 0.0, 0.25, 0.01, 0.0, 0.01]

    def apply_ackermann_controller_settings(self, actor: int, settings: wire.Packed) -> None:
        """Set the gains of CARLA's Ackermann controller, which is not served."""
        raise CallRefused("apply_ackermann_controller_settings is not served: the controller here has no gains")

    def apply_control_to_walker(self, actor: int, control: wire.WalkerControl) -> None:
        """Set a walker's control."""
        self.episode.walk(self.episode.body(actor, "walker"), control)

    def get_physics_control(self, actor: int) -> wire.Packed:
        """Return a vehicle's physics control."""
        vehicle = self.episode.find(actor, "vehicle")
        return describe_physics(vehicle, self.episode.world)

    def apply_physics_control(self, actor: int, physics: wire.Packed) -> None:
        """Set a vehicle's physics control: no effect, the physics follows from its size."""
        self.episode.find(actor, "vehicle")

    def get_telemetry_data(self, actor: int) -> wire.Packed:
        """Return a vehicle's telemetry."""
        vehicle = self.episode.find(actor, "vehicle")
        return describe_telemetry(vehicle, self.episode.speed(vehicle))

    def show_vehicle_debug_telemetry(self, actor: int, on: bool) -> None:
        """Show a vehicle's telemetry: no effect, there is no window."""
        self.episode.find(actor, "vehicle")

    def get_vehicle_light_state(self, actor: int) -> wire.Packed:
        """Return the flags of a vehicle's lamps."""
        return [self.episode.find(actor, "vehicle").lamps]

    def set_vehicle_light_state(self, actor: int, lamps: wire.Packed) -> None:
        """Set the flags of a vehicle's lamps."""
        flags = lamps[0] if isinstance(lamps, list) and lamps else lamps
        self.episode.find(actor, "vehicle").lamps = wire.read(int, flags) & 0xFFFFFFFF

    def get_vehicle_light_states(self) -> wire.Packed:
        """Return the flags of the lamps of all vehicles."""
        return [[actor.id, actor.lamps] for actor in self.episode.actors.values() if actor.kind == "vehicle"]

    def open_vehicle_door(self, actor: int, door: int) -> None:
        """Open a door: refused, vehicles here have none that open."""
        raise CallRefused("open_door is not served: vehicles here have no doors that open")

    def close_vehicle_door(self, actor: int, door: int) -> None:
        """Close a door: no effect."""
        self.episode.find(actor, "vehicle")

    def set_wheel_steer_direction(self, actor: int, wheel: int, angle_deg: float) -> None:
        """Turn a wheel visually: refused."""
        raise CallRefused("set_wheel_steer_direction is not served: wheels follow the steering")

    def get_wheel_steer_angle(self, actor: int, wheel: int) -> float:
        """Return the angle of a wheel [deg]."""
        vehicle = self.episode.find(actor, "vehicle")
        if wheel >= 2 or not self.episode.is_own(vehicle):
            return 0.0
        limit, _ = self.episode.steering(vehicle)
        return float(np.degrees(limit) * vehicle.control.steer)

    # ---- traffic lights

    def _light(self, actor: int) -> int:
        row = self.episode.find(actor).light
        if row is None:
            raise CallRefused(f"actor {actor} is no traffic light")
        return row

    def set_traffic_light_state(self, actor: int, state: int) -> None:
        """Set a traffic light's state."""
        self.episode.lights.set_state(self.episode.world, self._light(actor), state)

    def set_traffic_light_green_time(self, actor: int, seconds: float) -> None:
        """Set the time [s] for which a light stays green after it was set."""
        self.episode.lights.times_s[self._light(actor)][TIMES["green"]] = seconds

    def set_traffic_light_yellow_time(self, actor: int, seconds: float) -> None:
        """Set the time [s] for which a light stays yellow after it was set."""
        self.episode.lights.times_s[self._light(actor)][TIMES["yellow"]] = seconds

    def set_traffic_light_red_time(self, actor: int, seconds: float) -> None:
        """Set the time [s] for which a light stays red after it was set."""
        self.episode.lights.times_s[self._light(actor)][TIMES["red"]] = seconds

    def freeze_traffic_light(self, actor: int, frozen: bool) -> None:
        """Freeze all traffic lights, not only this one, as CARLA does."""
        self._light(actor)
        self.freeze_all_traffic_lights(frozen)

    def freeze_all_traffic_lights(self, frozen: bool) -> None:
        """Freeze or unfreeze all traffic lights."""
        self.episode.lights.frozen = frozen
        self.episode.world.apply(FreezeLights(frozen))

    def reset_traffic_light_group(self, actor: int) -> None:
        """Return the lights of a junction to their program."""
        row = self._light(actor)
        self.episode.lights.release(self.episode.world, self.episode.lights.approaches[row].junction)

    def reset_all_traffic_lights(self) -> None:
        """Return all lights to their programs."""
        self.episode.lights.release(self.episode.world)

    def get_group_traffic_lights(self, actor: int) -> wire.Packed:
        """Return the actor ids of the lights of a junction."""
        return [self.episode.light_number(row) for row in self.episode.lights.group(self._light(actor))]

    def get_light_boxes(self, actor: int) -> wire.Packed:
        """Return the bounding boxes of a traffic light's heads."""
        actor_found = self.episode.find(actor)
        self._light(actor)
        place = to_vector(self.episode.served.frame.to_location(actor_found.pose[:3, 3] + (0.0, 0.0, 2.9)))
        return [BoundingBox(place, (0.15, 0.15, 0.45), actor_found.transform.rotation)]

    # ---- Traffic Manager

    def is_traffic_manager_running(self, port: int) -> bool:
        """Return whether a Traffic Manager is registered at a port."""
        return port in self._managers

    def get_traffic_manager_running(self, port: int) -> wire.Packed:
        """Return the host and port of the Traffic Manager at a port."""
        return self._managers.get(port, ("", 0))

    def add_traffic_manager_running(self, place: tuple[str, int]) -> bool:
        """Register a Traffic Manager by host and port; return whether the port was free."""
        return self._managers.setdefault(place[1], place) is place

    def destroy_traffic_manager(self, port: int) -> bool:
        """Unregister the Traffic Manager at a port."""
        return self._managers.pop(port, None) is not None

    # ---- the world

    def get_weather_parameters(self) -> wire.Packed:
        """Return the weather."""
        return self.episode.weather

    def set_weather_parameters(self, weather: wire.WeatherParameters) -> None:
        """Set the weather."""
        self.episode.weather = weather

    def get_imui_gravity(self) -> float:
        """Return the acceleration that an IMU measures at rest [m/s^2]."""
        return 9.81

    def set_imui_gravity(self, value: float) -> None:
        """Set the acceleration that an IMU measures at rest: refused."""
        raise CallRefused("set_imui_sensor_gravity is not served: gravity is 9.81 m/s^2")

    def get_all_level_BBs(self, tag: int) -> wire.Packed:
        """Return the bounding boxes of the town's objects with a semantic tag."""
        return find_boxes(self.episode, tag)

    def get_environment_objects(self, tag: int) -> wire.Packed:
        """Return the town's objects with a semantic tag."""
        return list_scenery(self.episode, tag)

    def enable_environment_objects(self, numbers: wire.Packed, on: bool) -> None:
        """Show objects of the town; hiding them is refused."""
        if not on:
            raise CallRefused("enable_environment_objects(False) is not served: the town's things stay")

    def get_names_of_all_objects(self) -> wire.Packed:
        """Return the names of the town's objects."""
        return [row[3] for row in list_scenery(self.episode, 0xFF)]

    def project_point(self, location: Vector, direction: Vector, distance: float) -> wire.Packed:
        """Return the first hit of a ray up to `distance` [m], as an optional labelled point."""
        found = project_ray(self.episode, location, direction, distance)
        return [True, found[0]] if found else [False, [NOTHING, 0]]

    def cast_ray(self, start: Vector, end: Vector) -> wire.Packed:
        """Return the hits of a ray between two points [m], as labelled points."""
        way = np.subtract(end, start)
        length = float(np.linalg.norm(way))
        return project_ray(self.episode, start, tuple(way.tolist()), length) if length else []

    def query_lights_state(self, client: wire.Packed) -> wire.Packed:
        """Return the lights of CARLA's light manager: none."""
        return []

    def update_lights_state(self, client: wire.Packed, lights: wire.Packed, discard: wire.Packed = None) -> None:
        """Change lights of CARLA's light manager: no effect, there are none."""

    def update_day_night_cycle(self, client: wire.Packed, on: bool) -> None:
        """Switch lamps with the day: no effect, they always follow the sun."""

    def draw_debug_shape(self, shape: wire.Packed) -> None:
        """Draw a debug shape: no effect, there is no window."""

    def start_recorder(self, name: str, additional: bool) -> str:
        """Start recording the traffic; return the path of the file on the server."""
        return self.episode.recorder.start(name)

    def stop_recorder(self) -> None:
        """Write the recording."""
        self.episode.recorder.stop()

    def get_bones_transform(self, actor: int) -> wire.Packed:
        """Return a walker's bones: none."""
        self.episode.find(actor, "walker")
        return [[]]

    def set_bones_transform(self, actor: int, bones: wire.Packed) -> None:
        """Set a walker's bones: refused."""
        raise CallRefused("set_bones is not served: walkers here have no bones")

    def blend_pose(self, actor: int, share: float) -> None:
        """Blend a walker's pose: refused."""
        raise CallRefused("blend_pose is not served: walkers here have no bones")

    def enable_sensor_for_ros(self, sensor: wire.Packed) -> None:
        """Publish a sensor on ROS 2: refused."""
        raise CallRefused("enable_for_ros is not served")

    def disable_sensor_for_ros(self, sensor: wire.Packed) -> None:
        """Stop publishing a sensor on ROS 2: no effect."""

    def is_sensor_enabled_for_ros(self, sensor: wire.Packed) -> bool:
        """Return whether a sensor is published on ROS 2: never."""
        return False

    def are_gbuffers_enabled(self, sensor: int) -> bool:
        """Return whether a camera sends its G-buffer: never."""
        return False

    # ---- batches

    def apply_batch(self, commands: wire.Packed, tick: bool) -> wire.Packed:
        """Execute commands in order; return an actor id or an error for every command."""
        answers = [self._carry_out(command) for command in commands] if isinstance(commands, list) else []
        self.ticks += tick
        return answers

    def _carry_out(self, command: Any) -> list[Any]:
        """Execute a command of a batch, packed as [[number, fields]], and return its response."""
        try:
            match command:
                case [[int(number), [int() | list(), *_] as fields]] if 0 <= number < len(wire.COMMANDS):
                    name = wire.COMMANDS[number]
                case _:
                    raise wire.WireError(f"no command of CARLA {wire.VERSION}")
            if name == "spawn":
                return wire.succeed(self._spawn(*_read_spawn(list(fields))))
            if name == "console_command":
                raise CallRefused("console commands are not served")
            invoke(self, name, tuple(fields))
            return wire.succeed(fields[0])
        except (CallRefused, InputError, wire.WireError) as error:
            return wire.fail(str(error))

    def _spawn(
        self, description: wire.Description, transform: Transform, parent: int | None, then: tuple[wire.Packed, ...]
    ) -> int:
        actor = self.episode.spawn(description, transform, parent)
        for command in then:
            match command:
                case [[number, [_, *fields]]]:
                    self._carry_out([[number, [actor.id, *fields]]])
        return actor.id


def _read_spawn(fields: list[Any]) -> tuple[wire.Description, Transform, int | None, tuple[Any, ...]]:
    if len(fields) != 6:
        raise wire.WireError(f"{len(fields)} fields where 6 belong")
    kinds = (wire.Description, Transform, int | None, tuple[Any, ...])
    return tuple(map(wire.read, kinds, (*fields[:3], fields[5])))  # type: ignore[return-value]


@lru_cache(maxsize=256)
def _signature(name: str) -> tuple[Callable[..., Any], tuple[Any, ...], int]:
    """Return a call's method, argument types and number of required arguments. Raises `CallRefused` if unknown."""
    method = getattr(Calls, name, None)
    if name.startswith("_") or not callable(method) or "return" not in (hints := get_type_hints(method)):
        raise CallRefused(f"{shorten(name)} is not served here")
    kinds = tuple(kind for argument, kind in hints.items() if argument != "return")
    return method, kinds, len(kinds) - len(method.__defaults__ or ())


def invoke(calls: Calls, name: str, arguments: tuple[wire.Packed, ...]) -> wire.Packed:
    """Execute a call by name. Raises `CallRefused`, `InputError` or `WireError` where it is refused or malformed."""
    method, kinds, least = _signature(name)
    if not least <= len(arguments) <= len(kinds):
        raise wire.WireError(
            f"{name}: {len(arguments)} arguments where {least} belong; clients of CARLA {wire.VERSION} are served here"
        )
    try:
        read = [wire.read(kind, argument) for kind, argument in zip(kinds, arguments)]
    except wire.WireError as error:
        raise wire.WireError(f"{name}: {error}; clients of CARLA {wire.VERSION} are served here") from None
    return method(calls, *read)
