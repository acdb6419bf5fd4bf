"""Beam patterns of LiDAR models, from their makers' data sheets, and the LiDAR returns of CARLA.

Patterns are for `beams: <name>` in a rig: Velodyne VLP-16 (63-9229), HDL-32E (97-0038), VLP-32C (63-9378),
HDL-64E (63-HDL64E), VLS-128 "Alpha Prime" (63-9679) at 10 spins a second, and Ouster OS1-128 in its mode 1024x10.
Elevations are nominal: those of a unit differ by some hundredths of a degree.

CARLA's `sensor.lidar.ray_cast` (its documentation, core sensors, "Lidar sensor") gives a return at range d the
intensity exp(-a d), whatever the surface. A share of all rays is lost; of the rest, returns with an intensity below a
limit are lost with a probability that rises linearly from 0 at the limit to its value at intensity 0. Weather plays no
part.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config


class Beams(NamedTuple):
    """The beam pattern and range of a LiDAR model."""

    elevations_deg: tuple[float, ...]  # of each channel, from the highest
    azimuth_steps: int  # firings per spin
    range_m: float  # largest range


def _even(high: float, low: float, count: int) -> tuple[float, ...]:
    return tuple(float(elevation) for elevation in np.linspace(high, low, count).round(3))


_HDL64E = (*_even(2.0, 2.0 - 31 / 3, 32), *_even(-8.83, -24.33, 32))  # an upper and a lower block of lasers
_VLP32C = (
    *(15.0, 10.333, 7.0, 4.667, 3.333, 2.333),
    *(1.667, 1.333, 1.0, 0.667, 0.333, 0.0, -0.333, -0.667, -1.0, -1.333, -1.667, -2.0, -2.333, -2.667, -3.0, -3.333),
    *(-3.667, -4.0, -4.667, -5.333, -6.148, -7.254, -8.843, -11.31, -15.639, -25.0),
)
_VLS128 = (
    *(15.0, 11.75, 9.7, 8.43, 7.58, 6.98, 6.48, 6.08, 5.73, 5.43, 5.18, 4.98),
    *_even(4.83, -6.5, 104),
    *(-6.65, -6.85, -7.15, -7.65, -8.352, -9.244, -10.346, -11.742, -13.565, -16.042, -19.582, -25.0),
)

BEAMS: dict[str, Beams] = {
    "vlp16": Beams(_even(15.0, -15.0, 16), 1800, 100.0),
    "hdl32e": Beams(_even(10.67, -30.67, 32), 2170, 100.0),
    "vlp32c": Beams(_VLP32C, 1800, 200.0),
    "hdl64e": Beams(_HDL64E, 2083, 120.0),  # as on KITTI's car
    "os1_128": Beams(_even(22.5, -22.5, 128), 1024, 120.0),
    "vls128": Beams(_VLS128, 1800, 245.0),
}


class CarlaReturns(Config):
    """The attributes of CARLA's LiDAR, with CARLA's names and defaults."""

    atmosphere_attenuation_rate: float = Field(default=0.004, ge=0, le=10)  # a of intensity = exp(-a distance) [1/m]
    dropoff_general_rate: float = Field(default=0.45, ge=0, le=1)  # probability that any return is lost
    dropoff_intensity_limit: float = Field(default=0.8, ge=1e-6, le=1)  # weaker returns may be lost too
    dropoff_zero_intensity: float = Field(default=0.4, ge=0, le=1)  # probability of loss at intensity 0


def carla_returns(
    settings: CarlaReturns,
    directions: NDArray[np.float32],
    distance: NDArray[np.float32],
    noise_m: NDArray[np.float32],
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the point cloud of CARLA's LiDAR and the ray (M,) of each point.

    Points (M, 4) are x, y, z [m] in the sensor's frame and intensity. `directions` (N, 3) are unit rays, `distance`
    (N,) leads to the surfaces met (inf where none), `noise_m` (N,) are the errors of the measured ranges.
    """
    intensity = np.exp(-settings.atmosphere_attenuation_rate * distance)
    at_zero, limit = settings.dropoff_zero_intensity, settings.dropoff_intensity_limit
    lost = rng.random(len(distance)) < settings.dropoff_general_rate
    lost |= rng.random(len(distance)) < np.where(intensity > limit, 0.0, at_zero * (1 - intensity / limit))
    rays = np.flatnonzero(np.isfinite(distance) & ~lost)
    measured = (distance[rays] + noise_m[rays])[:, None]
    return np.concatenate((directions[rays] * measured, intensity[rays, None]), axis=1).astype(np.float32), rays
