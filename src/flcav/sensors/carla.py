"""Returns as CARLA's `sensor.lidar.ray_cast` reports them, for data that is to look like CARLA's.

Its documentation (core sensors, "Lidar sensor") gives the intensity of a return at range d as exp(-a d), whatever the
surface; a share of all rays is lost, and of the rest those of an intensity below a limit with a probability that rises
linearly to its value at intensity 0. Weather plays no part.
"""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config


class CarlaReturns(Config):
    """CARLA's sensor attributes and their defaults."""

    atmosphere_attenuation_rate: float = Field(default=0.004, ge=0, le=10)  # a of exp(-a distance) [1/m]
    dropoff_general_rate: float = Field(default=0.45, ge=0, le=1)  # share of all rays that is lost
    dropoff_intensity_limit: float = Field(default=0.8, ge=1e-6, le=1)  # weaker returns may be lost besides
    dropoff_zero_intensity: float = Field(default=0.4, ge=0, le=1)  # share lost of returns of intensity 0


def carla_returns(
    settings: CarlaReturns,
    directions: NDArray[np.float32],
    distance: NDArray[np.float32],
    noise_m: NDArray[np.float32],
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return (M, 4) points and (M,) the rays they come from.

    `directions` (N, 3) and `distance` (N,) are those of the surfaces met (inf where none), `noise_m` (N,) the errors
    of the measured ranges.
    """
    intensity = np.exp(-settings.atmosphere_attenuation_rate * distance)
    at_zero, limit = settings.dropoff_zero_intensity, settings.dropoff_intensity_limit
    lost = rng.random(len(distance)) < settings.dropoff_general_rate
    lost |= rng.random(len(distance)) < np.where(intensity > limit, 0.0, at_zero * (1 - intensity / limit))
    rays = np.flatnonzero(np.isfinite(distance) & ~lost)
    measured = (distance[rays] + noise_m[rays])[:, None]
    return np.concatenate((directions[rays] * measured, intensity[rays, None]), axis=1).astype(np.float32), rays
