"""Physics and telemetry of vehicles, as clients get them: arrays in the order of CARLA's records."""

from typing import Any

import numpy as np

from flcav.carla.server.actors import Actor
from flcav.world.dynamics.blueprints import blueprint
from flcav.world.live import LiveWorld

WHEEL_M = 0.35  # radius
TORQUE = [[0.0, 400.0], [1890.0, 500.0], [5729.0, 400.0]]  # of the engine over its speed [N m, 1/min]
GEARS = [[4.0, 0.5, 0.65], [2.0, 0.5, 0.65]]  # ratio, shares of the speed at which it shifts
STEERING = [[0.0, 1.0], [20.0, 0.9], [120.0, 0.7]]  # share of the angle over the speed [km/h]


def describe_physics(vehicle: Actor, world: LiveWorld) -> list[Any]:
    """Return a vehicle's physics: those of its size, and CARLA's defaults for what plays no part here."""
    made = blueprint(vehicle.category, 0, vehicle.size)
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


def describe_telemetry(vehicle: Actor, speed_mps: float) -> list[Any]:
    """Return a vehicle's telemetry."""
    control = vehicle.control
    wheel = [3.5] + [0.0] * 10
    return [speed_mps, control.steer, control.throttle, control.brake, 1000.0, max(control.gear, 1), 0.3, [wheel] * 4]
