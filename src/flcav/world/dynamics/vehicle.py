"""Vehicle dynamics: mechanical parameters, and the kinematic bicycle model with tyres of limited grip.

The bicycle model turns a vehicle about a point on the line of its rear axle: at the speed u its yaw rate is
u tan(steer) / wheelbase, and its centre moves sideways at the yaw rate times the distance to the rear axle (Rajamani,
Vehicle Dynamics and Control, 2012, section 2.2). The tyres pull the motion towards that of the model, with an
acceleration of at most `FRICTION` times gravity: a vehicle that is too fast for its curve understeers, and one that
was hit slides and spins until the tyres regain grip.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Mask
from flcav.config import InputError
from flcav.geometry import heading_vectors, left_vectors, wrap_angle
from flcav.world.map.parameters import PROPS
from flcav.world.map.relief import AXLE_SHARE
from flcav.world.shapes import SHAPES

STEER_LIMIT_RAD = float(np.radians(70.0))  # of the inner front wheel


class _Make(NamedTuple):
    """Mechanical parameters that the vehicles of a category share."""

    density: float  # mass over the volume of the box [kg/m^3]
    pull: float  # greatest acceleration by the engine [m/s^2]
    power: float  # of the engine, over the mass [W/kg]
    drag: float  # drag coefficient, referred to the frontal area
    brake: float  # greatest deceleration by the brakes [m/s^2]


_MAKES: dict[str, _Make] = {
    "car": _Make(115.0, 4.0, 70.0, 0.30, 8.0),
    "van": _Make(100.0, 3.2, 45.0, 0.35, 7.5),
    "truck": _Make(140.0, 1.6, 15.0, 0.60, 6.0),
    "bus": _Make(120.0, 1.4, 15.0, 0.60, 6.0),
    "motorcycle": _Make(95.0, 5.0, 130.0, 0.60, 8.0),
    "bicycle": _Make(47.0, 1.0, 3.0, 0.90, 4.0),
    "pedestrian": _Make(110.0, 0.0, 0.0, 1.00, 0.0),
    "prop": _Make(200.0, 0.0, 0.0, 1.00, 0.0),
}
VEHICLES = ("car", "van", "truck", "bus", "motorcycle", "bicycle")


@dataclass(frozen=True)
class BodyBlueprint:
    """Category, shape and mechanical parameters of a vehicle, a walker or a prop."""

    category: str  # one of `trace.CATEGORIES`, or "prop"
    shape: int  # row of `SHAPES[category]`, or of `PROPS`
    size: tuple[float, float, float]  # length, width, height [m]
    mass_kg: float  # [kg]
    engine_n: float  # greatest force of the engine [N]
    power_w: float  # greatest power of the engine [W]
    drag_area_m2: float  # drag coefficient times frontal area [m^2]
    brake_mps2: float  # greatest deceleration by the brakes [m/s^2]
    wheelbase_m: float  # distance of the axles, which are symmetric about the box's centre [m]
    steer_limit_rad: float = STEER_LIMIT_RAD  # greatest angle of the front wheels [rad]

    @property
    def inertia_kgm2(self) -> float:
        """The moment of inertia about the vertical axis [kg m^2], of a homogeneous box."""
        length, width, _ = self.size
        return self.mass_kg * (length**2 + width**2) / 12


def make_blueprint(category: str, shape: int = 0, size: tuple[float, float, float] | None = None) -> BodyBlueprint:
    """Return the mechanical parameters of a shape; `size` is length, width, height [m], by default the shape's.

    Raises `InputError` for an unknown category or shape, and for a size that is not positive.
    """
    shapes = PROPS if category == "prop" else SHAPES.get(category)
    if shapes is None:
        raise InputError(f"category '{category}': must be one of {', '.join((*SHAPES, 'prop'))}")
    if not 0 <= shape < len(shapes):
        raise InputError(f"shape {shape}: category '{category}' has the shapes 0 to {len(shapes) - 1}")
    length, width, height = size or shapes[shape][1:]
    if not all(0.05 <= side <= 100.0 for side in (length, width, height)):
        raise InputError(f"size {length}, {width}, {height}: must be between 0.05 and 100 m")
    make = _MAKES[category]
    mass = make.density * length * width * height
    return BodyBlueprint(
        category=category,
        shape=shape,
        size=(float(length), float(width), float(height)),
        mass_kg=mass,
        engine_n=mass * make.pull,
        power_w=mass * make.power,
        drag_area_m2=make.drag * width * height,
        brake_mps2=make.brake,
        wheelbase_m=2 * AXLE_SHARE * length,
    )


GRAVITY_MPS2 = 9.81
FRICTION = 0.9  # coefficient of tyres on a dry road
GRIP_MPS2 = FRICTION * GRAVITY_MPS2
AIR_KGPM3 = 1.2  # density of air
ROLLING_MPS2 = 0.015 * GRAVITY_MPS2  # deceleration by rolling resistance
HAND_BRAKE_MPS2 = 0.5 * GRIP_MPS2  # of the rear wheels alone
STEER_RADPS = 2.5  # steering rate of the front wheels
REVERSE_MPS = 8.0  # greatest speed in reverse gear


class PlanarMotion(NamedTuple):
    """The motion of N bodies in plan, world frame."""

    position: Array  # (N, 2) centre of the box [m]
    yaw: Array  # (N,) [rad]
    velocity: Array  # (N, 2) of the centre [m/s]
    yaw_rate: Array  # (N,) [rad/s]
    steer: Array  # (N,) angle of the front wheels, positive to the left [rad]


class Vehicles(NamedTuple):
    """The mechanical parameters of N vehicles, (N,) each: see `BodyBlueprint`."""

    mass_kg: Array
    engine_n: Array
    power_w: Array
    drag_area_m2: Array
    brake_mps2: Array
    wheelbase_m: Array
    steer_limit_rad: Array
    grip_mps2: Array  # (N,) greatest acceleration by the tyres [m/s^2]
    spin_mps2: Array  # (N,) greatest yaw acceleration by the tyres [rad/s^2]


class Pedals(NamedTuple):
    """Driving controls of N vehicles."""

    throttle: Array  # (N,) 0 to 1
    steer: Array  # (N,) -1 to 1, in steering limits, positive to the left
    brake: Array  # (N,) 0 to 1
    hand_brake: Mask  # (N,)
    reverse: Mask  # (N,)


def stack_blueprints(blueprints: list[BodyBlueprint]) -> Vehicles:
    """Return the mechanical parameters of vehicles as arrays."""
    rows = [
        (
            *(blueprint.mass_kg, blueprint.engine_n, blueprint.power_w, blueprint.drag_area_m2),
            *(blueprint.brake_mps2, blueprint.wheelbase_m, blueprint.steer_limit_rad),
            GRIP_MPS2,
            GRIP_MPS2 * blueprint.wheelbase_m / 2 * blueprint.mass_kg / blueprint.inertia_kgm2,
        )
        for blueprint in blueprints
    ]
    return Vehicles(*np.array(rows, np.float64).reshape(-1, len(Vehicles._fields)).T)


def drive_vehicles(motion: PlanarMotion, vehicles: Vehicles, pedals: Pedals, pitch: Array, dt_s: float) -> PlanarMotion:
    """Integrate the motion of N vehicles over `dt_s` [s], on slopes of `pitch` (N,) [rad], positive downhill."""
    ahead = heading_vectors(motion.yaw)
    speed = (motion.velocity * ahead).sum(axis=1)
    wanted = np.clip(pedals.steer, -1, 1) * vehicles.steer_limit_rad
    steer = motion.steer + np.clip(wanted - motion.steer, -STEER_RADPS * dt_s, STEER_RADPS * dt_s)
    speed = _accelerate(speed, vehicles, pedals, pitch, dt_s)
    limit = vehicles.grip_mps2 / np.maximum(np.abs(speed), 1e-3)
    turn = np.clip(speed * np.tan(steer) / vehicles.wheelbase_m, -limit, limit)
    spin = vehicles.spin_mps2 * dt_s
    yaw_rate = motion.yaw_rate + np.clip(turn - motion.yaw_rate, -spin, spin)
    yaw = motion.yaw + yaw_rate * dt_s
    # The velocity that the bicycle model wants; tyres change the present one towards it only within their grip.
    model = speed[:, None] * heading_vectors(yaw) + (turn * vehicles.wheelbase_m / 2)[:, None] * left_vectors(yaw)
    change = model - motion.velocity
    needed = np.linalg.norm(change, axis=1, keepdims=True)
    velocity = motion.velocity + change * np.minimum(
        1.0, vehicles.grip_mps2[:, None] * dt_s / np.maximum(needed, 1e-12)
    )
    position = motion.position + (motion.velocity + velocity) / 2 * dt_s
    return PlanarMotion(position, wrap_angle(yaw), velocity, yaw_rate, steer)


def _accelerate(speed: Array, vehicles: Vehicles, pedals: Pedals, pitch: Array, dt_s: float) -> Array:
    """Return the longitudinal speed (N,) [m/s] after `dt_s` [s]: engine, drag and slope, then brakes down to rest."""
    force = np.minimum(vehicles.engine_n, vehicles.power_w / np.maximum(np.abs(speed), 1e-3))
    force = np.clip(pedals.throttle, 0, 1) * np.where(pedals.reverse, -1 * (speed > -REVERSE_MPS), 1) * force
    drag = AIR_KGPM3 / 2 * vehicles.drag_area_m2 * speed * np.abs(speed)
    pulled = speed + ((force - drag) / vehicles.mass_kg + GRAVITY_MPS2 * np.sin(pitch)) * dt_s
    hold = np.clip(pedals.brake, 0, 1) * vehicles.brake_mps2 + pedals.hand_brake * HAND_BRAKE_MPS2 + ROLLING_MPS2
    hold = np.minimum(hold, vehicles.grip_mps2)
    return np.sign(pulled) * np.maximum(np.abs(pulled) - hold * dt_s, 0.0)
