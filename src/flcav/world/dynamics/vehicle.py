"""The kinematic bicycle model with tyres of limited grip.

The bicycle model turns a vehicle about a point on the line of its rear axle: at the speed u its yaw rate is
u tan(steer) / wheelbase, and its middle moves sideways by the yaw rate times the distance to the rear axle (Rajamani,
Vehicle Dynamics and Control, 2012, section 2.2). Tyres pull the motion towards that of the model, and change the
velocity by no more than `FRICTION` times gravity: a vehicle that is too fast for its curve understeers, and one that
was hit slides and spins until they hold it again.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import heading_vectors, left_vectors, wrap_angle
from flcav.world.dynamics.blueprints import Blueprint

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.81
FRICTION = 0.9  # of tyres on a dry road
GRIP_MPS2 = FRICTION * GRAVITY_MPS2
AIR_KGPM3 = 1.2  # density of air
ROLLING_MPS2 = 0.015 * GRAVITY_MPS2  # deceleration by rolling resistance
HAND_BRAKE_MPS2 = 0.5 * GRIP_MPS2  # of the rear wheels alone
STEER_RADPS = 2.5  # how fast the front wheels turn
REVERSE_MPS = 8.0  # the engine drives backwards no faster


class Motion(NamedTuple):
    """The motion of N bodies in plan, world frame."""

    position: Array  # (N, 2) middle of the box [m]
    yaw: Array  # (N,) [rad]
    velocity: Array  # (N, 2) of the middle [m/s]
    yaw_rate: Array  # (N,) [rad/s]
    steer: Array  # (N,) angle of the front wheels, positive to the left [rad]


class Vehicles(NamedTuple):
    """The parameters of N vehicles: see `Blueprint`."""

    mass_kg: Array
    engine_n: Array
    power_w: Array
    drag_area_m2: Array
    brake_mps2: Array
    wheelbase_m: Array
    steer_limit_rad: Array
    grip_mps2: Array  # (N,) greatest change of the velocity by the tyres
    spin_mps2: Array  # (N,) greatest change of the yaw rate by the tyres [rad/s^2]


class Pedals(NamedTuple):
    """What the drivers of N vehicles do."""

    throttle: Array  # (N,) 0 to 1
    steer: Array  # (N,) -1 to 1, share of the limit, positive to the left
    brake: Array  # (N,) 0 to 1
    hand_brake: NDArray[np.bool_]  # (N,)
    reverse: NDArray[np.bool_]  # (N,)


def stack_blueprints(blueprints: list[Blueprint]) -> Vehicles:
    """Return the parameters of vehicles as arrays."""
    rows = [
        (
            *(each.mass_kg, each.engine_n, each.power_w, each.drag_area_m2),
            *(each.brake_mps2, each.wheelbase_m, each.steer_limit_rad),
            GRIP_MPS2,
            GRIP_MPS2 * each.wheelbase_m / 2 * each.mass_kg / each.inertia_kgm2,
        )
        for each in blueprints
    ]
    return Vehicles(*np.array(rows, np.float64).reshape(-1, len(Vehicles._fields)).T)


def drive(motion: Motion, vehicles: Vehicles, pedals: Pedals, pitch: Array, dt_s: float) -> Motion:
    """Return the motion of N vehicles `dt_s` later, on slopes of this `pitch` (N,) [rad], positive downhill."""
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
    model = speed[:, None] * heading_vectors(yaw) + (turn * vehicles.wheelbase_m / 2)[:, None] * left_vectors(yaw)
    change = model - motion.velocity
    needed = np.linalg.norm(change, axis=1, keepdims=True)
    velocity = motion.velocity + change * np.minimum(
        1.0, vehicles.grip_mps2[:, None] * dt_s / np.maximum(needed, 1e-12)
    )
    position = motion.position + (motion.velocity + velocity) / 2 * dt_s
    return Motion(position, wrap_angle(yaw), velocity, yaw_rate, steer)


def _accelerate(speed: Array, vehicles: Vehicles, pedals: Pedals, pitch: Array, dt_s: float) -> Array:
    """Return the speed ahead (N,) [m/s] after `dt_s`: engine, drag and slope; then the brakes, at most to rest."""
    force = np.minimum(vehicles.engine_n, vehicles.power_w / np.maximum(np.abs(speed), 1e-3))
    force = np.clip(pedals.throttle, 0, 1) * np.where(pedals.reverse, -1 * (speed > -REVERSE_MPS), 1) * force
    drag = AIR_KGPM3 / 2 * vehicles.drag_area_m2 * speed * np.abs(speed)
    pulled = speed + ((force - drag) / vehicles.mass_kg + GRAVITY_MPS2 * np.sin(pitch)) * dt_s
    hold = np.clip(pedals.brake, 0, 1) * vehicles.brake_mps2 + pedals.hand_brake * HAND_BRAKE_MPS2 + ROLLING_MPS2
    hold = np.minimum(hold, vehicles.grip_mps2)
    return np.sign(pulled) * np.maximum(np.abs(pulled) - hold * dt_s, 0.0)
