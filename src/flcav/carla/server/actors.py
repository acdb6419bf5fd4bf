"""The actors that clients know, beside the bodies of the live world."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.carla.frames import MapFrame, mirror, mirror_spin, to_rotation
from flcav.carla.server import wire
from flcav.carla.server.sensing.sight import Sensor
from flcav.carla.server.sensing.table import Clock
from flcav.carla.server.wire import BoundingBox, Transform
from flcav.geometry import rotations
from flcav.sensors.frame import SEMANTICS
from flcav.world.snapshot import Snapshot

Array = NDArray[np.float64]

NOTHING = (0.0, 0.0, 0.0)
STILL = (NOTHING, NOTHING, NOTHING)
FIRST_LIMIT_KMH = 30.0  # CARLA's speed limit of a vehicle that has passed no sign
STANDING, WAITING = wire.VehicleControl(), wire.WalkerControl()


class Counters:
    """The numbers of actors, streams, frames and episodes, which a server never uses twice."""

    def __init__(self) -> None:
        self.actor = self.episode = self.frame = self.stream = 0

    def next_actor(self) -> int:
        """Return a number for an actor."""
        self.actor += 1
        return self.actor

    def next_stream(self) -> int:
        """Return a number for a stream."""
        self.stream += 1
        return self.stream


class Place(NamedTuple):
    """Where an actor is, and how it moves."""

    pose: Array  # (4, 4) world from body
    location: wire.Vector
    rotation: wire.Vector
    motion: Sequence[wire.Vector]  # velocity, angular velocity, acceleration


@dataclass
class Actor:
    """An actor, as clients know it."""

    id: int
    description: wire.Description
    transform: Transform
    pose: Array  # (4, 4) world from actor: the ground under a vehicle's middle, a walker's middle
    name: str = ""  # of its body in the live world; empty without one
    category: str = ""  # of that body
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)  # length, width, height [m]
    paint: wire.Vector | None = None  # linear RGB, of a vehicle that a client spawned
    parent: int = 0
    mount: Array | None = None  # (4, 4) parent from actor, of one that is attached
    stream: int = 0  # of a sensor
    sensor: Sensor | None = None
    clock: Clock | None = None
    light: int | None = None  # row of its approach, of a traffic light
    sign: str = ""  # its id in the map, of a traffic sign
    box: BoundingBox | None = None  # of a traffic light or sign
    motion: Sequence[wire.Vector] = STILL  # CARLA's velocity, angular velocity, acceleration
    control: wire.VehicleControl = STANDING
    walk: wire.WalkerControl = WAITING
    ackermann: wire.AckermannControl | None = None
    sticky: bool = True  # keeps its control; else it has one for a tick alone
    told: bool = False  # has got a control since the last tick
    limit_kmh: float = FIRST_LIMIT_KMH  # of speed, by the last sign that it passed
    lamps: int = 0  # flags of a vehicle's lamps
    simulated: bool = True
    falling: bool = True
    guided_s: float = 0.0  # time at which its AI last placed a walker
    constant: Array | None = None  # (3,) velocity that is kept up, in the body's frame [m/s]
    events: list[bytes] = field(default_factory=list)

    @property
    def kind(self) -> str:
        """The first part of its blueprint's name."""
        return self.description.id.partition(".")[0]

    @property
    def lift(self) -> float:
        """The height of its origin above its underside [m]: CARLA's walkers have theirs in the middle."""
        return self.size[2] / 2 if self.category == "pedestrian" else 0.0

    def bounding_box(self) -> BoundingBox:
        """Return its box in its own frame."""
        if self.box is not None:
            return self.box._replace(actor_id=self.id)
        length, width, height = self.size
        middle = (0.0, 0.0, height / 2 - self.lift)
        return BoundingBox(middle, (length / 2, width / 2, height / 2), actor_id=self.id)

    def record(self, port: int) -> wire.Actor:
        """Return it as clients get it; `port` is that of the streams."""
        token = wire.pack_token(self.stream, port) if self.stream else b""
        return wire.Actor(self.id, self.parent, self.description, self.bounding_box(), self.tags(), token)

    def tags(self) -> bytes:
        """Return CARLA's semantic tags."""
        if self.light is not None:
            return bytes([SEMANTICS["traffic_light"]])
        if self.sign:
            return bytes([SEMANTICS["traffic_sign"]])
        if not self.category:
            return b""
        names = {"van": "car", "prop": "static"}
        return bytes([SEMANTICS[names.get(self.category, self.category)]])

    def take(self, place: Place) -> None:
        """Take a place; the origin of a walker is its middle, `lift` above its feet."""
        self.pose, self.motion = place.pose, place.motion
        raised = self.lift * self.pose[:3, 2]
        self.pose[:3, 3] += raised
        (x, y, z), (dx, dy, dz) = place.location, mirror(raised).tolist()
        self.transform = Transform((x + dx, y + dy, z + dz), place.rotation)


def list_places(snapshot: Snapshot, frame: MapFrame, count: int) -> list[Place]:
    """Return the places of the first `count` actors of a snapshot; the parked ones are its last."""
    trace = snapshot.trace
    tilt, yaw, position = trace.tilts(0)[:count], trace.yaw[0, :count], trace.position[0, :count]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotations(yaw, *tilt.T)
    poses[:, :3, 3] = position
    spin = np.column_stack((np.zeros((count, 2)), trace.yaw_rate[0, :count]))
    columns = (
        frame.to_location(position),
        to_rotation(np.column_stack((yaw, tilt))),
        mirror(trace.velocity[0, :count]),
        np.degrees(mirror_spin(spin)),
        mirror(trace.acceleration[0, :count]),
    )
    rows = zip(*((map(tuple, column.tolist())) for column in columns))
    return [Place(pose, location, rotation, motion) for pose, (location, rotation, *motion) in zip(poses, rows)]
