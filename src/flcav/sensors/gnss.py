"""A satellite receiver: latitude, longitude and altitude with white noise and an error that wanders over a minute."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config
from flcav.sensors.drift import wander
from flcav.sensors.geodesy import geodetic
from flcav.world.scene import Scene

Array = NDArray[np.float64]


class Gnss(Config):
    """How good a receiver is; the defaults are those of a single-frequency receiver under open sky."""

    noise_m: float = Field(default=0.3, ge=0, le=1000)  # standard deviation of the white noise, east and north
    noise_up_m: float = Field(default=0.6, ge=0, le=1000)  # the same of the altitude
    bias_m: float = Field(
        default=1.2, ge=0, le=1000
    )  # standard deviation of what wanders (satellites, ionosphere), east, north
    bias_up_m: float = Field(default=2.4, ge=0, le=1000)  # the same of the altitude
    bias_s: float = Field(default=60.0, ge=0.001, le=1e6)  # time in which the bias is forgotten


def fix(
    scene: Scene, world_from_gnss: Array, gnss: Gnss, rng: np.random.Generator, bias_rng: np.random.Generator
) -> Array:
    """Return (3,) latitude [deg], longitude [deg], altitude [m] (WGS 84) of an antenna at the scene's time.

    `world_from_gnss` (4, 4) is the antenna's pose. `rng` is the frame's stream; `bias_rng` is at the start of the one
    stream of this receiver in this scene, so that the bias is the same whatever frames were rendered before.
    """
    time_s = float(scene.trace.time_s[scene.index]) + scene.offset_s
    noise = rng.standard_normal(3) * (gnss.noise_m, gnss.noise_m, gnss.noise_up_m)
    bias = wander(bias_rng, time_s, np.array((gnss.bias_m, gnss.bias_m, gnss.bias_up_m)), gnss.bias_s)
    return geodetic(scene.town.geo, world_from_gnss[:3, 3] + noise + bias)
