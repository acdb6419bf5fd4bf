"""GNSS and IMU simulation: white noise and drifting biases (Gauss-Markov process, random walk).

Biases are simulated on a grid of STEP_S from time 0 and interpolated linearly, so that the value at a time depends only
on the random stream and that time, not on the order of requests.

A GNSS receiver has white noise and a first-order Gauss-Markov bias. An IMU measures the specific force f = a - g (at
rest 9.8 m/s^2 upwards) and the angular rate; its white noise is given as a spectral density and its bias as a random
walk, as on data sheets (IEEE 952).
"""

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from flcav.arrays import Array
from flcav.config import Config
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.scene import Scene

STEP_S = 0.1  # step of the grid on which biases are simulated
GRAVITY = np.array((0.0, 0.0, -9.80665))  # [m/s^2]


def draw_gauss_markov(rng: np.random.Generator, time_s: ArrayLike, deviation: Array, correlation_s: float) -> Array:
    """Sample K independent stationary first-order Gauss-Markov processes at times `time_s` (...) >= 0 [s]: (..., K).

    They have the standard deviations `deviation` (K,) and the autocorrelation exp(-t / `correlation_s`).
    """
    from scipy.signal import lfilter  # imported late, since it takes a second and only GNSS needs it

    kept = np.exp(-STEP_S / correlation_s)
    normal = _grid(rng, time_s, len(deviation))
    normal[1:] *= np.sqrt(1 - kept**2)
    return deviation * _read(np.asarray(lfilter([1.0], [1.0, -kept], normal, axis=0)), time_s)


def draw_random_walk(rng: np.random.Generator, time_s: ArrayLike, start: Array, per_root_s: Array) -> Array:
    """Sample K independent random walks at the times `time_s` (...) >= 0 [s]: (..., K).

    The initial values have the standard deviations `start` (K,), increments over t seconds `per_root_s` (K,) * sqrt(t).
    """
    normal = _grid(rng, time_s, len(start))
    normal[0] *= start
    normal[1:] *= per_root_s * np.sqrt(STEP_S)
    return _read(np.cumsum(normal, axis=0), time_s)


def _grid(rng: np.random.Generator, time_s: ArrayLike, axes: int) -> Array:
    return rng.standard_normal((int(np.max(time_s) / STEP_S) + 2, axes))


def _read(values: Array, time_s: ArrayLike) -> Array:
    step, share = np.divmod(np.asarray(time_s, dtype=np.float64) / STEP_S, 1.0)
    step, share = step.astype(np.int64), share[..., None]
    return (1 - share) * values[step] + share * values[step + 1]


class Gnss(Config):
    """Error model of a GNSS receiver; the defaults are those of a single-frequency receiver under open sky."""

    noise_m: float = Field(default=0.3, ge=0, le=1000)  # standard deviation of the white noise, of east and of north
    noise_up_m: float = Field(default=0.6, ge=0, le=1000)  # standard deviation of the white noise, of altitude
    bias_m: float = Field(
        default=1.2, ge=0, le=1000
    )  # standard deviation of the Gauss-Markov bias (satellites, ionosphere), of east and of north
    bias_up_m: float = Field(default=2.4, ge=0, le=1000)  # standard deviation of the Gauss-Markov bias, of altitude
    bias_s: float = Field(default=60.0, ge=0.001, le=1e6)  # correlation time of the bias


def measure_position(
    scene: Scene, world_from_gnss: Array, gnss: Gnss, rng: np.random.Generator, bias_rng: np.random.Generator
) -> Array:
    """Measure a GNSS fix at the scene's time: (3,) latitude [deg], longitude [deg], altitude [m], WGS 84.

    `world_from_gnss` (4, 4) [m] is the antenna's pose. `rng` draws this frame's white noise. `bias_rng` draws the bias:
    a generator at the start of this receiver's stream of the scene, so that the bias does not depend on which frames
    were rendered before.
    """
    time_s = float(scene.trace.time_s[scene.index]) + scene.offset_s
    noise, bias = draw_fix_errors(gnss, time_s, rng, bias_rng)
    return convert_to_geodetic(scene.town.geo, world_from_gnss[:3, 3] + noise + bias)


def draw_fix_errors(
    gnss: Gnss, time_s: ArrayLike, rng: np.random.Generator, bias_rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw noise and bias (..., 3) east, north, up [m] of fixes at `time_s` (...) [s]; see `measure_position`."""
    noise = rng.standard_normal((*np.shape(time_s), 3)) * (gnss.noise_m, gnss.noise_m, gnss.noise_up_m)
    bias = draw_gauss_markov(bias_rng, time_s, np.array((gnss.bias_m, gnss.bias_m, gnss.bias_up_m)), gnss.bias_s)
    return noise, bias


class Imu(Config):
    """Error model of an IMU; the defaults are those of an automotive MEMS unit."""

    rate_hz: float = Field(default=100.0, ge=0.1, le=10_000)  # sampling rate: noise up to half of it passes
    force_noise: float = Field(default=1.5e-3, ge=0, le=1000)  # noise density of the specific force [m/s^2 / sqrt(Hz)]
    rate_noise: float = Field(default=1.0e-4, ge=0, le=1000)  # noise density of the angular rate [rad/s / sqrt(Hz)]
    force_bias: float = Field(default=0.05, ge=0, le=1000)  # standard deviation of initial bias, specific force [m/s^2]
    rate_bias: float = Field(default=2.0e-3, ge=0, le=1000)  # standard deviation of initial bias, angular rate [rad/s]
    force_walk: float = Field(default=1.0e-4, ge=0, le=1000)  # random walk of bias, specific force [m/s^2 / sqrt(s)]
    rate_walk: float = Field(default=5.0e-6, ge=0, le=1000)  # random walk of bias, angular rate [rad/s / sqrt(s)]


def measure_inertia(
    scene: Scene,
    world_from_imu: Array,
    carrier: int | None,
    imu: Imu,
    rng: np.random.Generator,
    bias_rng: np.random.Generator,
) -> Array:
    """Measure an IMU sample at the scene's time: (6,) specific force [m/s^2] and angular rate [rad/s], IMU frame.

    `world_from_imu` (4, 4) [m] is its pose, `carrier` the actor that carries it (None: it is stationary). `rng` draws
    this frame's white noise. `bias_rng` draws the bias: a generator at the start of this unit's stream of the scene, so
    that the bias does not depend on which frames were rendered before.
    """
    time_s = float(scene.trace.time_s[scene.index]) + scene.offset_s
    turn = world_from_imu[:3, :3]
    acceleration, rate = _motion(scene, world_from_imu[:3, 3], carrier)
    true = np.concatenate((turn.T @ (acceleration - GRAVITY), turn.T @ rate))
    noise, bias = draw_imu_errors(imu, time_s, rng, bias_rng)
    return true + noise + bias


def draw_imu_errors(
    imu: Imu, time_s: ArrayLike, rng: np.random.Generator, bias_rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw noise and bias (..., 6) [m/s^2, rad/s] of IMU samples at `time_s` (...) [s]; see `measure_inertia`."""
    noise = np.repeat((imu.force_noise, imu.rate_noise), 3) * np.sqrt(imu.rate_hz / 2)
    start = np.repeat((imu.force_bias, imu.rate_bias), 3)
    growth = np.repeat((imu.force_walk, imu.rate_walk), 3)
    return noise * rng.standard_normal((*np.shape(time_s), 6)), draw_random_walk(bias_rng, time_s, start, growth)


def _motion(scene: Scene, at: Array, carrier: int | None) -> tuple[Array, Array]:
    """Return acceleration [m/s^2] and angular rate [rad/s] (3,) of the carrier at a point (3,) [m], world frame."""
    if carrier is None:
        return np.zeros(3), np.zeros(3)
    trace = scene.trace
    index = scene.index
    rate = np.array((0.0, 0.0, trace.yaw_rate[index, carrier]))
    arm = at - scene.world_from_actor(carrier)[:3, 3]
    return trace.acceleration[index, carrier] + np.cross(rate, np.cross(rate, arm)), rate
