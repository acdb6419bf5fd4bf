"""Actors as clients see them, with their bodies in the live world, and the control of vehicles."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from flcav.carla.frames import MapFrame, mirror, mirror_spin, to_rotation
from flcav.carla.server import wire
from flcav.carla.server.blueprints import FLOAT, TRIGGER
from flcav.carla.server.sensors import SensorClock
from flcav.carla.server.sight import Sensor
from flcav.carla.server.wire import AckermannControl, BoundingBox, Transform, VehicleControl
from flcav.geometry import Array, rotations
from flcav.sensors.frame import SEMANTICS
from flcav.world.commands import Grip
from flcav.world.dynamics.bodies import ControlledBody
from flcav.world.dynamics.vehicle import make_blueprint
from flcav.world.live import LiveWorld
from flcav.world.snapshot import Snapshot

NOTHING = (0.0, 0.0, 0.0)
STILL = (NOTHING, NOTHING, NOTHING)
FIRST_LIMIT_KMH = 30.0  # CARLA's speed limit of a vehicle that has passed no sign
STANDING, WAITING = wire.VehicleControl(), wire.WalkerControl()


class Counters:
    """Counters of actors, streams, frames and episodes: a server never reuses an id."""

    def __init__(self) -> None:
        self.actor = self.episode = self.frame = self.stream = 0

    def next_actor(self) -> int:
        """Return a new actor id."""
        self.actor += 1
        return self.actor

    def next_stream(self) -> int:
        """Return a new stream id."""
        self.stream += 1
        return self.stream


class ActorPose(NamedTuple):
    """The pose and motion of an actor, in the world frame and in CARLA's left-handed frame."""

    pose: Array  # (4, 4) world from body [m]
    location: wire.Vector  # CARLA's frame [m]
    rotation: wire.Vector  # CARLA's pitch, yaw, roll [deg]
    motion: Sequence[wire.Vector]  # CARLA's velocity [m/s], angular velocity [deg/s], acceleration [m/s^2]


@dataclass
class ServedActor:
    """An actor as clients see it."""

    id: int
    description: wire.Description
    transform: Transform  # CARLA's frame [m], [deg]
    pose: Array  # (4, 4) world from actor [m]; origin: the ground below a vehicle's centre, a walker's centre
    name: str = ""  # of its body in the live world; empty without a body
    category: str = ""  # of that body
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)  # length, width, height [m]
    paint: wire.Vector | None = None  # linear RGB of a vehicle that a client spawned
    parent: int = 0  # id of the actor that it is attached to; 0: none
    mount: Array | None = None  # (4, 4) parent from actor [m], of an attached actor
    stream: int = 0  # id of a sensor's stream
    sensor: Sensor | None = None
    clock: SensorClock | None = None
    light: int | None = None  # row of a traffic light's approach
    sign: str = ""  # id of a traffic sign in the map
    box: BoundingBox | None = None  # of a traffic light or sign
    motion: Sequence[wire.Vector] = STILL  # CARLA's velocity [m/s], angular velocity [deg/s], acceleration [m/s^2]
    control: wire.VehicleControl = STANDING
    walk: wire.WalkerControl = WAITING
    ackermann: wire.AckermannControl | None = None
    sticky: bool = True  # it keeps its control; otherwise a control holds for one tick
    told: bool = False  # it has received a control since the last tick
    limit_kmh: float = FIRST_LIMIT_KMH  # speed limit by the last sign that it passed [km/h]
    lamps: int = 0  # flags of a vehicle's lamps
    simulated: bool = True  # with physics
    falling: bool = True  # with gravity
    guided_s: float = 0.0  # simulation time at which a walker was last placed by its AI [s]
    constant: Array | None = None  # (3,) velocity that is kept constant, body frame [m/s]
    events: list[bytes] = field(default_factory=list)

    @property
    def kind(self) -> str:
        """The kind of actor: the first part of its blueprint's name."""
        return self.description.id.partition(".")[0]

    @property
    def lift(self) -> float:
        """The height of its origin above its underside [m]: the origin of CARLA's walkers is their centre."""
        return self.size[2] / 2 if self.category == "pedestrian" else 0.0

    def bounding_box(self) -> BoundingBox:
        """Return its bounding box in the actor frame [m]."""
        if self.box is not None:
            return self.box._replace(actor_id=self.id)
        length, width, height = self.size
        middle = (0.0, 0.0, height / 2 - self.lift)
        return BoundingBox(middle, (length / 2, width / 2, height / 2), actor_id=self.id)

    def record(self, port: int) -> wire.ActorRecord:
        """Return the record of the actor that clients receive; `port` is the streams' port."""
        token = wire.pack_token(self.stream, port) if self.stream else b""
        return wire.ActorRecord(self.id, self.parent, self.description, self.bounding_box(), self.tags(), token)

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

    def take(self, place: ActorPose) -> None:
        """Take over a pose and motion; the origin of a walker is raised by `lift` to its centre."""
        self.pose, self.motion = place.pose, place.motion
        raised = self.lift * self.pose[:3, 2]
        self.pose[:3, 3] += raised
        (x, y, z), (dx, dy, dz) = place.location, mirror(raised).tolist()
        self.transform = Transform((x + dx, y + dy, z + dz), place.rotation)


def list_places(snapshot: Snapshot, frame: MapFrame, count: int) -> list[ActorPose]:
    """Return the poses and motions of the first `count` actors of a snapshot; parked vehicles are its last."""
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
    return [ActorPose(pose, location, rotation, motion) for pose, (location, rotation, *motion) in zip(poses, rows)]


PULL_MPS2, BRAKE_MPS2 = 4.0, 8.0  # acceleration and deceleration at full pedals
SHIFT_KMH = (20.0, 40.0, 60.0, 85.0, 115.0)  # speeds at which an automatic gearbox shifts up
SETTLE_S = 0.5  # time constant of the speed controller
STOPPED_MPS = 0.05


def choose_gear(control: VehicleControl, speed_mps: float) -> int:
    """Return the gear of a vehicle: the manual one, or that of an automatic gearbox at its speed [m/s]."""
    if control.manual:
        return control.gear
    return -1 if control.reverse else 1 + int(np.searchsorted(SHIFT_KMH, 3.6 * abs(speed_mps)))


def find_grip(box: ServedActor, point: Array) -> float | None:
    """Return the friction, over that of a dry road, in a friction trigger; None if `point` (3,) [m] is outside."""
    values = {
        attribute.id: float(attribute.value) for attribute in box.description.attributes if attribute.type == FLOAT
    }
    half = [values[f"extent_{axis}"] / 100 for axis in "xyz"]
    inside = np.abs(box.pose[:3, :3].T @ (point - box.pose[:3, 3])) <= half
    return min(values["friction"], 1.0) if inside.all() else None


def list_grips(actors: Collection[ServedActor], bodies: Iterable[ControlledBody]) -> list[Grip]:
    """Return the changed grips of vehicles; a vehicle has that of the last friction trigger that contains it."""
    known = {actor.name: actor for actor in actors if actor.kind == "vehicle"}
    boxes = [actor for actor in actors if actor.description.id == TRIGGER]
    changed = []
    for body in bodies:
        if (actor := known.get(body.name)) is not None:
            shares = [share for box in boxes if (share := find_grip(box, actor.pose[:3, 3])) is not None]
            share = shares[-1] if shares else 1.0
            if body.grip != share:
                changed.append(Grip(body.name, share))
    return changed


def steer_towards(
    told: AckermannControl, now: VehicleControl, speed_mps: float, limit_rad: float, dt_s: float
) -> VehicleControl:
    """Return a vehicle's control for one step of `dt_s` [s] that follows an Ackermann control (speed P controller).

    `speed_mps` is the present speed [m/s], `limit_rad` the greatest steering angle [rad].
    """
    steer = min(max(told.steer / limit_rad, -1.0), 1.0)
    if told.steer_speed > 0:
        most = told.steer_speed / limit_rad * dt_s
        steer = min(max(steer, now.steer - most), now.steer + most)
    wanted = (told.speed - speed_mps) / SETTLE_S
    if told.acceleration > 0:
        wanted = min(max(wanted, -told.acceleration), told.acceleration)
    backwards = told.speed < 0
    push = -wanted if backwards else wanted
    if abs(told.speed) < STOPPED_MPS and abs(speed_mps) < STOPPED_MPS:
        return VehicleControl(steer=steer, brake=1.0, hand_brake=True)
    if push >= 0:
        return VehicleControl(throttle=min(push / PULL_MPS2, 1.0), steer=steer, reverse=backwards)
    return VehicleControl(steer=steer, brake=min(-push / BRAKE_MPS2, 1.0), reverse=backwards)


WHEEL_M = 0.35  # radius
TORQUE = [[0.0, 400.0], [1890.0, 500.0], [5729.0, 400.0]]  # of the engine over its speed [N m, 1/min]
GEARS = [[4.0, 0.5, 0.65], [2.0, 0.5, 0.65]]  # ratio, shares of the speed at which it shifts
STEERING = [[0.0, 1.0], [20.0, 0.9], [120.0, 0.7]]  # share of the angle over the speed [km/h]


def describe_physics(vehicle: ServedActor, world: LiveWorld) -> list[Any]:
    """Return a vehicle's physics control: values by its size, and CARLA's defaults for those without effect here."""
    made = make_blueprint(vehicle.category, 0, vehicle.size)
    steer = float(np.degrees(made.steer_limit_rad))
    wheels = []
    for front in (True, False):
        for left in (True, False):
            along = made.wheelbase_m / 2 * (1 if front else -1)
            across = vehicle.size[1] * 0.4 * (1 if left else -1)
            x, y, z = (vehicle.pose @ (along, across, WHEEL_M, 1.0))[:3]
            place = [100.0 * x, -100.0 * y, 100.0 * z]  # [cm]
            turns, hand = (steer, 0.0) if front else (0.0, 3000.0)
            wheels.append([3.5, 0.25, turns, 100 * WHEEL_M, 1500.0, hand, 2.0, 17.0, 1000.0, place])
    engine = [TORQUE, 5729.0, 1.0, 0.15, 2.0, 0.35]
    gearbox = [True, 0.5, 10.0, 4.0, GEARS]
    return [*engine, *gearbox, made.mass_kg, 0.3, [0.45, 0.0, -0.3], STEERING, wheels, True]


def describe_telemetry(vehicle: ServedActor, speed_mps: float) -> list[Any]:
    """Return a vehicle's telemetry at its speed [m/s], as packed for clients."""
    control = vehicle.control
    wheel = [3.5] + [0.0] * 10
    return [speed_mps, control.steer, control.throttle, control.brake, 1000.0, max(control.gear, 1), 0.3, [wheel] * 4]
