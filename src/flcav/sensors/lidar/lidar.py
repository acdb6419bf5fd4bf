"""Simulation of a spinning LiDAR: ray casting through glass, the power equation, fog and rain, and detection.

The power received from a surface, relative to that of a white one at normal incidence at 1 m, is
P = reflectivity * cos(incidence) / R^2; it is detected above P_min = 0.9 / R_max^2 (LISA, arXiv 2107.07004, section 3).
Rain, fog and wet roads change P; clear weather needs no computation for them and draws no random numbers.

CARLA's `sensor.lidar.ray_cast` (its documentation, core sensors, "Lidar sensor") gives a return at range d the
intensity exp(-a d), independent of the surface. A share of all rays is lost; of the rest, returns with an intensity
below a limit are lost with a probability that rises linearly from 0 at the limit to its value at intensity 0. Weather
has no effect.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from flcav.arrays import Array, Array32, Ints, Ints32, Mask
from flcav.config import Config
from flcav.geometry import unit_vectors
from flcav.sensors.lidar.air import add_air_returns, compute_air
from flcav.sensors.lidar.beams import BEAMS
from flcav.sensors.lidar.returns import (
    LEVELS,
    QUANTILES,
    Returns,
    cast_through_glass,
    compute_brightness,
    detect_returns,
)
from flcav.sensors.lidar.rolling import step_sectors, time_in_spin_s
from flcav.world.rays.packets import Hits
from flcav.world.scene import OFFSET_S, Scene
from flcav.world.weather import Weather


class CarlaReturns(Config):
    """The attributes of CARLA's LiDAR, with CARLA's names and defaults."""

    atmosphere_attenuation_rate: float = Field(default=0.004, ge=0, le=10)  # a of intensity = exp(-a distance) [1/m]
    dropoff_general_rate: float = Field(default=0.45, ge=0, le=1)  # probability that any return is lost
    dropoff_intensity_limit: float = Field(default=0.8, ge=1e-6, le=1)  # weaker returns may be lost too
    dropoff_zero_intensity: float = Field(default=0.4, ge=0, le=1)  # probability of loss at intensity 0


def carla_returns(
    settings: CarlaReturns, directions: Array32, distance: Array32, noise_m: Array32, rng: np.random.Generator
) -> tuple[Array32, Ints]:
    """Return the point cloud of CARLA's LiDAR, and the rays (M,) of its points.

    Points (M, 4) are x, y, z [m], sensor frame, and intensity. `directions` (N, 3) are unit rays, `distance` (N,) [m]
    the distances of the hits (inf where none), `noise_m` (N,) the errors of the measured ranges.
    """
    intensity = np.exp(-settings.atmosphere_attenuation_rate * distance)
    at_zero, limit = settings.dropoff_zero_intensity, settings.dropoff_intensity_limit
    lost = rng.random(len(distance)) < settings.dropoff_general_rate
    lost |= rng.random(len(distance)) < np.where(intensity > limit, 0.0, at_zero * (1 - intensity / limit))
    rays = np.flatnonzero(np.isfinite(distance) & ~lost)
    measured = (distance[rays] + noise_m[rays])[:, None]
    return np.concatenate((directions[rays] * measured, intensity[rays, None]), axis=1).astype(np.float32), rays


CLEAR = Weather()


class Lidar(Config):
    """Settings of a spinning LiDAR; its mount is in the rig."""

    beams: str | None = None  # name of a model: its elevations, and its azimuth steps and range by default
    channels: int = Field(default=32, ge=1, le=256)  # number of beams, one above the other
    azimuth_steps: int = Field(default=900, ge=4, le=8192)  # firings of each channel in one spin
    range_m: float = Field(default=80.0, ge=0.1, le=1000)  # maximum range; farther returns are not reported
    up_deg: float = Field(default=3.0, ge=-90, le=90)  # elevation of the highest channel
    down_deg: float = Field(default=-25.0, ge=-90, le=90)  # elevation of the lowest channel
    elevations_deg: tuple[float, ...] | None = None  # elevation of each channel, if they are not evenly spaced
    rate_hz: float = Field(default=10.0, ge=0.1, le=100)  # spins per second
    sensitivity_m: float = Field(
        default=300.0, ge=0.1, le=1e5
    )  # R_max: detection range of a white surface at normal incidence in clear air
    noise_m: float = Field(default=0.02, ge=0, le=1)  # standard deviation of the measured range
    dropout: float = Field(default=0.005, ge=0, lt=1)  # probability that a return is lost, whatever its power
    glass_pass: float = Field(default=0.9, ge=0, le=1)  # fraction of rays that pass panes of glass
    divergence_rad: float = Field(default=0.003, ge=1e-6, le=0.05)  # beam divergence, full angle
    roughness_rad: float = Field(default=0.0, ge=0, le=1.5)  # Oren-Nayar roughness of ground, masonry, plants and cloth
    intensity_gamma: float = Field(default=1.0, ge=0.01, le=2)  # intensity = brightness^gamma
    intensity_floor: float = Field(default=0.0, ge=0, lt=1)  # intensities below this value are reported as 0
    rolling: bool = False  # rolling shutter: traffic and sensor move during the spin
    carla: CarlaReturns | None = None  # CARLA's detection model, in place of the power equation

    @model_validator(mode="before")
    @classmethod
    def _name_of_beams(cls, values: Any) -> Any:
        name = values.get("beams") if isinstance(values, dict) else None
        if not isinstance(name, str):
            return values
        if name not in BEAMS:
            raise ValueError(f"no beams '{name}'; known beams: {', '.join(BEAMS)}")
        known = BEAMS[name]
        settled = {"channels": len(known.elevations_deg), "elevations_deg": known.elevations_deg}
        for field, value in settled.items():
            given = values.get(field)
            if given is not None and (tuple(given) if isinstance(given, list) else given) != value:
                raise ValueError(f"beams '{name}' settle {field}; leave it out")
        return {"azimuth_steps": known.azimuth_steps, "range_m": known.range_m} | values | settled

    @model_validator(mode="after")
    def _check_spin(self) -> "Lidar":
        if self.rolling and self.rate_hz < 0.5 / OFFSET_S:
            raise ValueError(f"a rolling spin takes at most {2 * OFFSET_S} s: rate_hz must be {0.5 / OFFSET_S} or more")
        return self

    @model_validator(mode="after")
    def _check_elevations(self) -> "Lidar":
        if self.elevations_deg is not None:
            if len(self.elevations_deg) != self.channels:
                raise ValueError(
                    f"{self.channels} channels need as many elevations_deg, not {len(self.elevations_deg)}"
                )
            if any(abs(elevation) > 90 for elevation in self.elevations_deg):
                raise ValueError("every one of elevations_deg must lie within -90 and 90")
        elif self.channels > 1 and self.down_deg >= self.up_deg:
            raise ValueError(f"down_deg {self.down_deg} must be below up_deg {self.up_deg}")
        return self


class Scan(NamedTuple):
    """The point cloud of one spin, and its rays."""

    points: Array32  # (M, 4) x, y, z [m], sensor frame, intensity in [0, 1]
    actor: Ints32  # (M,) row of the trace's actor that the point is on; -1 for the town, rain and fog
    passes: Mask  # (N,) whether the ray passes the panes of glass that it meets
    returns: Returns  # the surfaces that the N rays return from


def build_ray_pattern(lidar: Lidar) -> Array32:
    """Return the ray directions of one spin: (channels * azimuth_steps, 3) unit vectors, sensor frame; read-only.

    They are ordered by channel from the highest; within a channel, azimuth runs counter-clockwise from straight ahead.
    """
    return _build_ray_pattern(lidar.channels, lidar.up_deg, lidar.down_deg, lidar.elevations_deg, lidar.azimuth_steps)


@lru_cache(maxsize=16)
def _build_ray_pattern(
    channels: int, up_deg: float, down_deg: float, elevations_deg: tuple[float, ...] | None, steps: int
) -> Array32:
    even = np.linspace(up_deg, down_deg, channels)
    elevation = np.radians(even if elevations_deg is None else np.sort(elevations_deg)[::-1])[:, None]
    azimuth = np.arange(steps)[None] * (2 * np.pi / steps)
    directions = unit_vectors(azimuth, elevation).reshape(-1, 3).astype(np.float32)
    directions.flags.writeable = False
    return directions


def draw_passes(lidar: Lidar, rng: np.random.Generator) -> Mask:
    """Draw (N,) whether rays of the pattern pass all panes of glass that they meet."""
    return rng.random(lidar.channels * lidar.azimuth_steps, np.float32) < lidar.glass_pass


def cast(scene: Scene, world_from_sensor: Array, lidar: Lidar, passes: Mask, hidden: int | None = None) -> Returns:
    """Cast the rays of one spin; return the surfaces within range that they return from, without the actor `hidden`.

    `world_from_sensor` (4, 4) [m] is the sensor's pose; `passes` (N,) marks rays that pass through glass. A rolling
    LiDAR moves with `hidden`, its carrier, or is stationary if that is None.
    """
    pattern, surfaces = build_ray_pattern(lidar), scene.surfaces

    def part(pose: Array, rays: Ints | slice) -> Returns:
        directions = pattern[rays]

        def trace(rays: Ints | slice, *, near_m: Array32 | None = None) -> Hits:
            return scene.cast(pose, directions[rays], near_m=near_m, far_m=lidar.range_m, hidden=hidden)

        return cast_through_glass(trace, passes[rays], surfaces.first, surfaces.material)

    if not lidar.rolling:
        return part(world_from_sensor, slice(None))
    # The sensor and the traffic move during a rolling spin: sectors are cast one by one, at their own times.
    steps = lidar.azimuth_steps
    count = len(pattern)
    numbers, kinds = np.empty((2, count), np.int32), np.empty((2, count), np.uint8)
    whole = Returns(np.empty(count, np.float32), numbers[0], numbers[1], kinds[0], kinds[1])
    for columns, pose in step_sectors(scene, world_from_sensor, steps, 1 / lidar.rate_hz, hidden):
        rays = (np.arange(lidar.channels)[:, None] * steps + columns).ravel()
        for values, sector_values in zip(whole, part(pose, rays)):
            values[rays] = sector_values
    return whole


def measure_points(
    scene: Scene,
    world_from_sensor: Array,
    lidar: Lidar,
    echoes: Returns,
    rng: np.random.Generator,
    weather: Weather | None = None,
) -> tuple[Array32, Ints32]:
    """Return the detected points (M, 4) of a spin and the actors (M,) that they are on: see `Scan`.

    `echoes` are the surfaces that the spin's rays return from; `weather` is clear by default.
    """
    rays = len(echoes.distance)
    chance = rng.random(rays, np.float32)
    noise = rng.integers(LEVELS, size=rays, dtype=np.uint16)
    source = echoes.instance - 1
    if lidar.carla is not None:
        error_m = np.float32(lidar.noise_m) * QUANTILES[noise]
        points, reported = carla_returns(lidar.carla, build_ray_pattern(lidar), echoes.distance, error_m, rng)
        return points, source[reported]

    weather = weather or CLEAR
    sensor_from_instance = (world_from_sensor[:3, :3].T @ scene.world_from_instance()).astype(np.float32)
    bright = compute_brightness(
        echoes, build_ray_pattern(lidar), scene.surfaces, sensor_from_instance, weather.wetness, lidar.roughness_rad
    )
    distance = echoes.distance
    least_power = 0.9 / lidar.sensitivity_m**2
    air = compute_air(weather, lidar.divergence_rad, 0.7 * least_power)
    if air is not None:
        distance, bright, aerial = add_air_returns(distance, bright, air, rng)
        source = np.where(aerial, -1, source)
    points = np.empty((rays, 4), np.float32)
    actor = np.empty(rays, np.int32)
    kept = detect_returns(
        build_ray_pattern(lidar),
        distance,
        bright,
        source,
        np.float32(lidar.sensitivity_m**2 / 0.9),
        np.float32(1 - lidar.dropout),
        chance,
        noise,
        np.float32(lidar.noise_m),
        np.float32(air.range_noise if air else 0.0),
        points,
        actor,
    )
    compress_intensity(points[:kept], lidar)
    return points[:kept], actor[:kept]


def compress_intensity(points: Array32, lidar: Lidar) -> None:
    """Apply the sensor's gamma and floor to the intensities of `points` (N, 4), in place."""
    if lidar.intensity_gamma != 1:
        points[:, 3] **= np.float32(lidar.intensity_gamma)
    if lidar.intensity_floor > 0:
        points[points[:, 3] < lidar.intensity_floor, 3] = 0


def scan(
    scene: Scene,
    world_from_sensor: Array,
    lidar: Lidar,
    rng: np.random.Generator,
    hidden: int | None = None,
    weather: Weather | None = None,
) -> Scan:
    """Simulate one spin at the scene's instant, without the actor `hidden` (the carrier).

    `world_from_sensor` (4, 4) [m] is the sensor's pose; `weather` is clear by default.
    """
    passes = draw_passes(lidar, rng)
    returns = cast(scene, world_from_sensor, lidar, passes, hidden)
    return Scan(*measure_points(scene, world_from_sensor, lidar, returns, rng, weather), passes, returns)


def point_times_s(lidar: Lidar, points: Array32) -> Array32:
    """Return the times (N,) of points (N, >=2), sensor frame, relative to the middle of the spin [s].

    They are from -0.5 / `rate_hz` to 0.5 / `rate_hz` for a rolling LiDAR, else 0.
    """
    return time_in_spin_s(points, 1 / lidar.rate_hz) if lidar.rolling else np.zeros(len(points), np.float32)
