"""The wire format of CARLA 0.9.16: values of remote procedure calls, batch commands and sensor streams.

A call is the MessagePack array [0, id, method, [[is async], argument, ...]], its reply [1, id, nil, response]; messages
have no length prefix. Records are arrays of their fields, so the named tuples here are packed as they are. An optional
is [false] or [true, value], a variant [index, value]; a response is [[1, value]], [[false]] without a value, or
[[0, [message]]] for an error. Streams are little-endian: u32 size and payload, beginning with a header of 48 bytes.
Locations are in metres, rotations pitch, yaw and roll in degrees, both in CARLA's left-handed frame.
"""

import struct
from collections.abc import Sequence
from enum import IntEnum
from functools import lru_cache
from types import UnionType
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import msgpack
import numpy as np
from numpy.typing import NDArray

from flcav.config import Json

VERSION = "0.9.16"
HEADER = struct.Struct("<QQd6f")
WORLD = struct.Struct("<Qdf3iI")
VEHICLE = struct.Struct("<3f3?ifB?IB")
WALKER = struct.Struct("<4f?")
LIGHT = struct.Struct("<32s4fI?B")
TOKEN = struct.Struct("<IHBB16s")
ACTOR = struct.Struct("<IB6f3f3f3f54s")  # the last field is `VEHICLE`, `WALKER` or `LIGHT`, by kind
SEMANTIC_POINT = np.dtype([("xyz", "<f4", 3), ("cosine", "<f4"), ("actor", "<u4"), ("tag", "<u4")])
FARTHEST = 1e9  # greater numbers are refused
ACTIVE, TCP = 1, 1

Vector = tuple[float, float, float]
Packed = Json | bytes  # a value on the wire


class WireError(ValueError):
    """A message that violates the protocol of CARLA 0.9.16."""


class Stream(IntEnum):
    """The kind of a sensor's stream."""

    COLLISION = 0
    DEPTH = 1
    GNSS = 4
    IMU = 5
    LANE_INVASION = 6
    OBSTACLE = 7
    RADAR = 9
    SEMANTIC_LIDAR = 10
    LIDAR = 11
    RGB = 13
    SEMANTIC = 14
    INSTANCE = 15
    WORLD = 17


class Transform(NamedTuple):
    """A pose in CARLA's left-handed frame."""

    location: Vector  # x, y, z [m]
    rotation: Vector  # pitch, yaw, roll [deg]


class BoundingBox(NamedTuple):
    """A bounding box in the frame of its actor, or of the world."""

    location: Vector  # of its centre [m]
    extent: Vector  # half of its length, width and height [m]
    rotation: Vector = (0.0, 0.0, 0.0)  # pitch, yaw, roll [deg]
    actor_id: int = 0


class Attribute(NamedTuple):
    """An attribute of an actor with its value."""

    id: str
    type: int  # 1 Bool, 2 Int, 3 Float, 4 String, 5 RGB
    value: str


class Description(NamedTuple):
    """The description of an actor: its blueprint and attributes."""

    uid: int
    id: str
    attributes: tuple[Attribute, ...]


class Variation(NamedTuple):
    """An attribute of a blueprint with its default and recommended values."""

    id: str
    type: int
    value: str
    recommended: tuple[str, ...]
    modifiable: bool
    restricted: bool  # to the recommended values


class Definition(NamedTuple):
    """A blueprint."""

    uid: int
    id: str
    tags: str  # comma-separated
    attributes: tuple[Variation, ...]


class ActorRecord(NamedTuple):
    """The record of an actor that clients receive."""

    id: int
    parent: int
    description: Description
    box: BoundingBox
    tags: bytes
    token: bytes  # of a sensor's stream; empty without one


class EpisodeSettings(NamedTuple):
    """The settings of an episode; times in [s], distances in [m]."""

    synchronous: bool = False
    no_rendering: bool = False
    fixed_dt_s: float | None = None
    substepping: bool = True
    substep_s: float = 0.01
    substeps: int = 10
    culling_m: float = 0.0
    ragdolls: bool = True
    tile_m: float = 3000.0
    active_m: float = 2000.0
    spectator_ego: bool = True

    def packed(self) -> list[Any]:
        """Return the settings as the array on the wire."""
        fixed = [False] if self.fixed_dt_s is None else [True, self.fixed_dt_s]
        return [self.synchronous, self.no_rendering, fixed, *self[3:]]


class WeatherParameters(NamedTuple):
    """CARLA's weather; percentages are from 0 to 100."""

    cloudiness: float = 0.0  # [%]
    precipitation: float = 0.0  # rain [%]
    precipitation_deposits: float = 0.0  # puddles [%]
    wind_intensity: float = 0.0  # [%]
    sun_azimuth_angle: float = 0.0  # [deg]
    sun_altitude_angle: float = 0.0  # elevation, from -90 to 90 [deg]
    fog_density: float = 0.0  # [%]
    fog_distance: float = 0.0  # distance at which fog begins [m]
    fog_falloff: float = 0.0  # decrease of the density of fog with height, from 0 on
    wetness: float = 0.0  # of roads [%]
    scattering_intensity: float = 0.0
    mie_scattering_scale: float = 0.0
    rayleigh_scattering_scale: float = 0.0331
    dust_storm: float = 0.0  # [%]


class VehicleControl(NamedTuple):
    """The control of a vehicle."""

    throttle: float = 0.0  # 0 to 1
    steer: float = 0.0  # -1 to 1, positive to the right
    brake: float = 0.0  # 0 to 1
    hand_brake: bool = False
    reverse: bool = False
    manual: bool = False
    gear: int = 0


class AckermannControl(NamedTuple):
    """An Ackermann control: target steering angle and speed."""

    steer: float  # [rad], positive to the right
    steer_speed: float  # greatest rate of the angle [rad/s]; 0: unlimited
    speed: float  # [m/s]
    acceleration: float  # greatest acceleration [m/s^2]; 0: unlimited
    jerk: float  # [m/s^3], without effect here


class WalkerControl(NamedTuple):
    """The control of a walker: direction and speed."""

    direction: Vector = (1.0, 0.0, 0.0)
    speed: float = 0.0  # [m/s]
    jump: bool = False


class CollisionEvent(NamedTuple):
    """The message of a collision sensor."""

    actor: ActorRecord
    other: ActorRecord
    impulse: Vector  # on the actor [N s]


class ObstacleEvent(NamedTuple):
    """The message of an obstacle sensor."""

    actor: ActorRecord
    other: ActorRecord
    distance: float  # [m]


# The calls that batch commands correspond to, by index; their fields are the arguments.
COMMANDS: tuple[str, ...] = (
    "spawn",
    "destroy_actor",
    "apply_control_to_vehicle",
    "apply_ackermann_control_to_vehicle",
    "apply_control_to_walker",
    "apply_physics_control",
    "set_actor_transform",
    "set_walker_state",
    "set_actor_target_velocity",
    "set_actor_target_angular_velocity",
    "add_actor_impulse",
    "add_actor_force",
    "add_actor_angular_impulse",
    "add_actor_torque",
    "set_actor_simulate_physics",
    "set_actor_enable_gravity",
    "set_actor_autopilot",
    "show_vehicle_debug_telemetry",
    "set_vehicle_light_state",
    "set_actor_location",
    "console_command",
    "set_traffic_light_state",
)


# ---- calls


class Call(NamedTuple):
    """A remote procedure call."""

    number: int | None  # id of its reply; None: a notification, which has no reply
    method: str
    arguments: tuple[Any, ...]


def pack_value(value: Any) -> bytes:
    """Serialise a value as MessagePack."""
    packed = msgpack.packb(value, unicode_errors="surrogateescape")
    assert packed is not None, "it returns bytes; its types say that it may not"
    return packed


def read_call(message: Any) -> Call:
    """Parse an unpacked message as a call. Raises `WireError` where it is none."""
    match message:
        case [0, int(number), str(method), [_, *arguments]]:
            return Call(number, method, tuple(arguments))
        case [2, str(method), [_, *arguments]]:
            return Call(None, method, tuple(arguments))
    raise WireError("a message that is no call of CARLA 0.9.16")


def succeed(value: Any) -> list[Any]:
    """Return the response with a value."""
    return [[1, value]]


DONE: list[Any] = [[False]]  # the response without a value


def fail(message: str) -> list[Any]:
    """Return the response of a refused call."""
    return [[0, [message]]]


def pack_reply(number: int, response: Any) -> bytes:
    """Serialise a reply."""
    return pack_value([1, number, None, response])


def read(kind: Any, value: Any) -> Any:
    """Validate an unpacked value as the type `kind`: a number, text, bytes, named tuple, tuple or optional of these.

    `Any` and `Packed` accept every value. Raises `WireError` for a value of another type.
    """
    return _reader(kind)(value)


@lru_cache(maxsize=256)
def _reader(kind: Any) -> Any:
    """Return the function that validates values of a type."""
    if kind in (Any, Packed):
        return lambda value: value
    if kind is float:
        return _read_float
    if kind is int:
        return _read_int
    if kind in (bool, str, bytes):
        return lambda value: _read_plain(kind, value)
    if get_origin(kind) in (Union, UnionType):
        inner = _reader(next(element for element in get_args(kind) if element is not type(None)))
        return lambda value: _read_optional(inner, value)
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        if parts[-1] is Ellipsis:
            element = _reader(parts[0])
            return lambda value: tuple(element(part) for part in _array(value))
        return lambda value: _read_fields(tuple, tuple(map(_reader, parts)), value)
    fields = tuple(_reader(hint) for hint in get_type_hints(kind).values())
    return lambda value: _read_fields(kind._make, fields, value)


def _array(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise WireError("a value where a list belongs")
    return value


def _read_fields(make: Any, fields: tuple[Any, ...], value: Any) -> Any:
    if len(_array(value)) != len(fields):
        raise WireError(f"{len(value)} fields where {len(fields)} belong")
    return make([field(part) for field, part in zip(fields, value, strict=True)])


def _read_optional(inner: Any, value: Any) -> Any:
    match value:
        case [False]:
            return None
        case [True, inside]:
            return inner(inside)
    raise WireError("a value where an optional belongs")


def _read_float(value: Any) -> float:
    if type(value) not in (int, float) or not abs(value) < FARTHEST:
        raise WireError("a value where a finite number belongs")
    return float(value)


def _read_int(value: Any) -> int:
    if type(value) is not int:
        raise WireError("a value where a whole number belongs")
    return value


def _read_plain(kind: type, value: Any) -> Any:
    if type(value) is not kind:
        raise WireError(f"a value where a {kind.__name__} belongs")
    return value


# ---- streams


def pack_token(stream: int, port: int) -> bytes:
    """Return the token of a stream at a port of the host that the client is connected to."""
    return TOKEN.pack(stream, port, TCP, 0, b"")


def pack_header(kind: Stream, frame: int, time_s: float, transform: Transform) -> bytes:
    """Serialise the header of a payload: frame number, simulation time [s] and pose of the sensor."""
    return HEADER.pack(kind, frame, time_s, *transform.location, *transform.rotation)


def pack_world(episode: int, platform_s: float, dt_s: float, actors: Sequence[bytes]) -> bytes:
    """Serialise the body of the world state.

    `platform_s` is the wall-clock time [s], `dt_s` the length of the tick [s].
    """
    return WORLD.pack(episode, platform_s, dt_s, 0, 0, 0, 0) + b"".join(actors)


def pack_actor(actor: int, transform: Transform, motion: Sequence[Vector], union: bytes = b"") -> bytes:
    """Serialise an actor's state; `motion` is velocity [m/s], angular velocity [deg/s] and acceleration [m/s^2]."""
    return ACTOR.pack(
        actor, ACTIVE, *transform.location, *transform.rotation, *motion[0], *motion[1], *motion[2], union
    )


def pack_vehicle(control: VehicleControl, gear: int, limit_kmh: float, light: int, at_light: bool, by: int) -> bytes:
    """Serialise a vehicle's state: control, speed limit [km/h], and the traffic light it is at (actor `by`)."""
    return VEHICLE.pack(*control[:6], gear, limit_kmh, light, at_light, by, 0)


def pack_walker(control: WalkerControl) -> bytes:
    """Serialise a walker's state."""
    return WALKER.pack(*control.direction, control.speed, control.jump)


def pack_light(
    sign: str, times_s: tuple[float, float, float], elapsed_s: float, pole: int, frozen: bool, state: int
) -> bytes:
    """Serialise a traffic light's state: OpenDRIVE id, times of green, yellow and red [s], time in its state [s]."""
    return LIGHT.pack(sign.encode()[:31], *times_s, elapsed_s, pole, frozen, state)


def pack_sign(sign: str) -> bytes:
    """Serialise a traffic sign's state: its OpenDRIVE id."""
    return sign.encode()[:31]


def pack_image(width: int, height: int, fov_deg: float, bgra: NDArray[np.uint8]) -> bytes:
    """Serialise an image (H, W, 4) of blue, green, red and alpha, and its horizontal field of view [deg]."""
    return struct.pack("<IIf", width, height, fov_deg) + bgra.tobytes()


def pack_lidar(angle_rad: float, per_channel: NDArray[np.integer], points: NDArray[Any]) -> bytes:
    """Serialise a LiDAR sweep: points by channel, as rows of float32 (x, y, z [m], intensity) or `SEMANTIC_POINT`."""
    return struct.pack("<fI", angle_rad, len(per_channel)) + per_channel.astype("<u4").tobytes() + points.tobytes()


def pack_record(record: Any) -> bytes:
    """Serialise a message that is sent as MessagePack: of GNSS, IMU, collision and obstacle sensors."""
    return pack_value(record)
