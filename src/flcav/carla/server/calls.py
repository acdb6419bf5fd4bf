"""The remote procedure calls of CARLA 0.9.16's clients.

A method of `Calls` handles the call of the same name: its annotations are the types on the wire, and its result is the
value of the reply. A `CallRefused` becomes the reply's error. Vectors are in CARLA's left-handed frame.
"""

from collections.abc import Callable
from functools import lru_cache
from hashlib import sha256
from typing import Any, get_type_hints

import numpy as np

from flcav.carla.server import wire
from flcav.carla.server.actor_calls import ActorCalls
from flcav.carla.server.actors import NOTHING, Counters
from flcav.carla.server.blueprints import CallRefused, Quality
from flcav.carla.server.episode import Episode
from flcav.carla.server.maps import Maps
from flcav.carla.server.scenery import find_boxes, list_scenery, project_ray
from flcav.carla.server.wire import Transform, Vector
from flcav.config import InputError, shorten

DT_RANGE_S = (0.001, 10.0)


class Calls(ActorCalls):
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
