"""An inertial measurement unit: specific force and angular rate of its carrier's motion, with noise and bias.

Specific force is what an accelerometer feels, f = a - g: at rest, 9.8 m/s^2 upwards. White noise is given as a spectral
density and the bias as a random walk, as on data sheets (IEEE 952).
"""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config
from flcav.sensors.drift import walk
from flcav.world.scene import Scene

Array = NDArray[np.float64]

GRAVITY = np.array((0.0, 0.0, -9.80665))  # [m/s^2]


class Imu(Config):
    """How good a unit is; the defaults are those of an automotive MEMS unit."""

    rate_hz: float = Field(default=100.0, ge=0.1, le=10_000)  # samples a second: how much of the noise passes
    force_noise: float = Field(default=1.5e-3, ge=0, le=1000)  # white noise of the specific force [m/s^2 / sqrt(Hz)]
    rate_noise: float = Field(default=1.0e-4, ge=0, le=1000)  # the same of the angular rate [rad/s / sqrt(Hz)]
    force_bias: float = Field(default=0.05, ge=0, le=1000)  # standard deviation when switched on [m/s^2]
    rate_bias: float = Field(default=2.0e-3, ge=0, le=1000)  # the same of the angular rate [rad/s]
    force_walk: float = Field(default=1.0e-4, ge=0, le=1000)  # growth of this bias [m/s^2 / sqrt(s)]
    rate_walk: float = Field(default=5.0e-6, ge=0, le=1000)  # the same of the angular rate [rad/s / sqrt(s)]


def reading(
    scene: Scene,
    world_from_imu: Array,
    carrier: int | None,
    imu: Imu,
    rng: np.random.Generator,
    bias_rng: np.random.Generator,
) -> Array:
    """Return (6,) specific force [m/s^2] and angular rate [rad/s] in the unit's own frame, at the scene's time.

    `world_from_imu` (4, 4) is its pose, `carrier` the actor it is on (None: it stands still). `rng` is the frame's
    stream; `bias_rng` is at the start of the one stream of this unit in this scene, so that the bias is the same
    whatever frames were rendered before.
    """
    time_s = float(scene.trace.time_s[scene.index]) + scene.offset_s
    turn = world_from_imu[:3, :3]
    acceleration, rate = _motion(scene, world_from_imu[:3, 3], carrier)
    true = np.concatenate((turn.T @ (acceleration - GRAVITY), turn.T @ rate))
    noise = np.repeat((imu.force_noise, imu.rate_noise), 3) * np.sqrt(imu.rate_hz / 2)
    start = np.repeat((imu.force_bias, imu.rate_bias), 3)
    growth = np.repeat((imu.force_walk, imu.rate_walk), 3)
    return true + noise * rng.standard_normal(6) + walk(bias_rng, time_s, start, growth)


def _motion(scene: Scene, at: Array, carrier: int | None) -> tuple[Array, Array]:
    """Return (3,) acceleration of the carrier's point `at` (3,) and (3,) its angular rate, world frame."""
    if carrier is None:
        return np.zeros(3), np.zeros(3)
    trace, index = scene.trace, scene.index
    rate = np.array((0.0, 0.0, trace.yaw_rate[index, carrier]))
    arm = at - scene.world_from_actor(carrier)[:3, 3]
    return trace.acceleration[index, carrier] + np.cross(rate, np.cross(rate, arm)), rate
