"""A 77 GHz radar: rays find who reflects, resolution cells sum it up, and a detector with a false alarm rate decides.

The radar equation gives each cell's signal-to-noise ratio, S = K g(direction) sigma L(rain) / r^4, with g the two-way
antenna gain. A cell fluctuates as Swerling's case 1: its measured power, in units of the noise, is exponential with
mean 1 + S and is reported above T = -ln(P_fa); so a target is detected with the probability P_fa^(1 / (1 + S))
(Richards, "Fundamentals of Radar Signal Processing", section 6.3). Errors of a reported value shrink with the square
root of the power. Only the first surface counts: no reflections by way of the road, none through glass.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config
from flcav.sensors.rcs import actor_rcs, silhouette, town_rcs_per_area
from flcav.world.rays.raycaster import Hits
from flcav.world.scene import Scene
from flcav.world.weather import Weather

Array = NDArray[np.float64]

REFERENCE_M2 = 10.0  # of the target that `detects_car_m` speaks of
RAYS_PER_CELL = 3  # along azimuth and elevation
EDGE_DB = 6.0  # two-way gain at the edge of the field of view, below that ahead
SPLIT = 1.6  # how many times finer than a cell a value is read at a signal-to-noise ratio of 1/2 (Barton)
LIMBS_M_S = {"pedestrian": 0.5, "bicycle": 0.5}  # deviation of the speed of what moves on them
RAIN_DB = (1.13, 0.718)  # k, a of k R^a [dB/km] at 77 GHz: ITU-R P.838-3


class Radar(Config):
    """What a radar is built like; the defaults are those of a front radar of a car."""

    range_m: float = Field(default=120.0, gt=0, le=500)
    azimuth_deg: float = Field(default=120.0, gt=0, le=170)  # field of view, whole
    elevation_deg: float = Field(default=20.0, gt=0, le=90)
    speed_m_s: float = Field(default=70.0, gt=0)  # Doppler measured up to here, either way
    range_cell_m: float = Field(default=0.4, gt=0)
    azimuth_cell_deg: float = Field(default=2.0, gt=0)
    elevation_cell_deg: float = Field(default=5.0, gt=0)
    doppler_cell_m_s: float = Field(default=0.2, gt=0)
    detects_car_m: float = Field(default=150.0, gt=0)  # 10 dBsm ahead are detected half the time at this range
    false_alarm_rate: float = Field(default=1e-6, gt=0, lt=0.1)  # of one cell in one sweep

    def resolution(self) -> Array:
        """Return (4,) a cell's range [m], azimuth [rad], elevation [rad] and Doppler [m/s]."""
        angles = np.radians((self.azimuth_cell_deg, self.elevation_cell_deg))
        return np.array((self.range_cell_m, *angles, self.doppler_cell_m_s))

    def extent(self) -> Array:
        """Return (4, 2) lowest and highest range [m], azimuth [rad], elevation [rad] and Doppler [m/s]."""
        azimuth, elevation = np.radians((self.azimuth_deg, self.elevation_deg)) / 2
        limits = ((0.0, self.range_m), (-azimuth, azimuth), (-elevation, elevation), (-self.speed_m_s, self.speed_m_s))
        return np.array(limits)


def radar_sweep(
    scene: Scene,
    world_from_radar: Array,
    velocity: Array,
    radar: Radar,
    rng: np.random.Generator,
    *,
    hidden: int | None = None,
    weather: Weather | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return one sweep of a radar that moves with `velocity` (3,) [m/s, world], nearest detections first.

    The first array is (N, 5): range [m], azimuth [rad, to the left], elevation [rad, upwards], Doppler [m/s, positive
    where the distance grows] and radar cross-section [dBsm]; the second (N,): the trace's actor that most of the
    echo comes from, -1 for the town and for false alarms. `hidden` is the carrier.
    """
    directions, solid_angle = _rays(radar, rng)
    hits = scene.cast(world_from_radar, directions, far_m=radar.range_m, hidden=hidden)
    met = np.flatnonzero(hits.instance >= 0)
    hits = Hits(hits.distance[met], hits.instance[met], hits.face[met])
    ahead = directions[met].astype(np.float64)
    sigma = _cross_sections(scene, world_from_radar, ahead, hits, solid_angle[met])
    speed = _range_rates(scene, world_from_radar, ahead, hits, velocity, rng)
    away = hits.distance.astype(np.float64)
    values = np.column_stack((away, np.arctan2(ahead[:, 1], ahead[:, 0]), np.arcsin(ahead[:, 2]), speed))
    cells = _cells(values, sigma, hits.instance - 1, radar)
    rain = weather.rain_mm_h if weather else 0.0
    measured, actor = _detect(cells, radar, rain, rng)
    alarms = _false_alarms(radar, rain, rng)
    everything = np.concatenate((measured, alarms)).astype(np.float32)
    owner = np.concatenate((actor, np.full(len(alarms), -1))).astype(np.int32)
    order = np.argsort(everything[:, 0], kind="stable")
    return everything[order], owner[order]


class _Cells(NamedTuple):
    """What the resolution cells that hold anything hold."""

    values: Array  # (C, 4) range, azimuth, elevation, Doppler: means weighted by cross-section
    sigma: Array  # (C,) [m^2]
    actor: NDArray[np.int64]  # (C,) the loudest; -1 for the town


def _rays(radar: Radar, rng: np.random.Generator) -> tuple[NDArray[np.float32], Array]:
    """Return (N, 3) directions, one at random in each cell of a grid over the field of view, and (N,) their [sr]."""
    _, (left, right), (low, high), _ = radar.extent()
    _, azimuth_cell, elevation_cell, _ = radar.resolution()
    columns = int(np.ceil((right - left) / azimuth_cell * RAYS_PER_CELL))
    rows = int(np.ceil((high - low) / elevation_cell * RAYS_PER_CELL))
    row, column = np.divmod(np.arange(rows * columns), columns)
    azimuth = left + (column + rng.random(len(column))) * (right - left) / columns
    elevation = low + (row + rng.random(len(row))) * (high - low) / rows
    level = np.cos(elevation)
    directions = np.column_stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)))
    return directions.astype(np.float32), level * ((right - left) / columns) * ((high - low) / rows)


def _cross_sections(scene: Scene, world_from_radar: Array, ahead: Array, hits: Hits, solid_angle: Array) -> Array:
    """Return (N,) [m^2] of the patch of surface that each ray stands for."""
    surfaces = scene.surfaces
    row = surfaces.first[hits.instance] + hits.face
    turn = world_from_radar[:3, :3].T @ scene.world_from_instance()
    normal = np.einsum("nij,nj->ni", turn[hits.instance], surfaces.normal[row].astype(np.float64))
    cosine = np.abs((normal * ahead).sum(axis=1))
    per_area = town_rcs_per_area(surfaces.material[row], cosine)

    seen = np.unique(hits.instance[hits.instance > 0]) - 1
    trace, index = scene.trace, scene.index
    away = world_from_radar[:2, 3] - trace.position[index, seen, :2]
    aspect = np.arctan2(away[:, 1], away[:, 0]) - trace.yaw[index, seen]
    of_actor = np.zeros(len(trace.actor))
    of_actor[seen] = actor_rcs(trace.category[seen], aspect) / silhouette(trace.size[seen], aspect)
    per_area = np.where(hits.instance > 0, of_actor[hits.instance - 1], per_area)
    return per_area * solid_angle * hits.distance.astype(np.float64) ** 2


def _range_rates(
    scene: Scene, world_from_radar: Array, ahead: Array, hits: Hits, velocity: Array, rng: np.random.Generator
) -> Array:
    """Return (N,) how fast the distance of what each ray meets grows [m/s]."""
    trace, index = scene.trace, scene.index
    limbs = np.array([LIMBS_M_S.get(str(category), 0.0) for category in trace.category])
    line = ahead @ world_from_radar[:3, :3].T
    moving = np.flatnonzero(hits.instance > 0)
    actor = hits.instance[moving] - 1
    at = world_from_radar[:3, 3] + hits.distance[moving, None] * line[moving]
    arm = at - trace.position[index, actor]
    spin = trace.yaw_rate[index, actor]
    swing = np.column_stack((-spin * arm[:, 1], spin * arm[:, 0], np.zeros(len(spin))))
    relative = np.tile(-velocity, (len(ahead), 1))
    relative[moving] += trace.velocity[index, actor] + swing
    rate = (relative * line).sum(axis=1)
    rate[moving] += limbs[actor] * rng.standard_normal(len(moving))
    return rate


def _cells(values: Array, sigma: Array, actor: NDArray[np.int32], radar: Radar) -> _Cells:
    low = radar.extent()[:, 0]
    key = np.floor((values - low) / radar.resolution()).astype(np.int64)
    order = np.lexsort((-sigma, *key.T))  # the loudest of a cell first
    values, sigma, key = values[order], sigma[order], key[order]
    fresh = np.ones(len(key), bool)
    fresh[1:] = (key[1:] != key[:-1]).any(axis=1)
    starts = np.flatnonzero(fresh)
    total = np.add.reduceat(sigma, starts) if len(starts) else sigma
    weighted = np.add.reduceat(values * sigma[:, None], starts) if len(starts) else values
    return _Cells(weighted / np.maximum(total, 1e-30)[:, None], total, actor[order][starts].astype(np.int64))


def _snr_per_m2(radar: Radar, values: Array, rain_mm_h: float) -> Array:
    """Return (N,) the signal-to-noise ratio of 1 m^2 at `values` (N, >=3) range, azimuth, elevation."""
    threshold = -np.log(radar.false_alarm_rate)
    at_reference = threshold / np.log(2) - 1  # detected half the time
    gain_db = -EDGE_DB * ((values[:, 1:3] / radar.extent()[1:3, 1]) ** 2).sum(axis=1)
    distance = np.maximum(values[:, 0], radar.range_cell_m)
    k, a = RAIN_DB
    loss_db = 2 * distance / 1e3 * k * rain_mm_h**a
    return at_reference / REFERENCE_M2 * (radar.detects_car_m / distance) ** 4 * 10 ** ((gain_db - loss_db) / 10)


def _detect(cells: _Cells, radar: Radar, rain_mm_h: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Return (M, 5) what is reported of the cells that are detected, and (M,) their actors."""
    per_m2 = _snr_per_m2(radar, cells.values, rain_mm_h)
    power = (1 + per_m2 * cells.sigma) * rng.standard_exponential(len(per_m2))
    found = power > -np.log(radar.false_alarm_rate)
    power = power[found]
    values = cells.values[found]
    values = values + rng.standard_normal(values.shape) * radar.resolution() / (SPLIT * np.sqrt(2 * power))[:, None]
    low, high = radar.extent().T
    inside = ((values >= low) & (values <= high)).all(axis=1)
    reported = np.column_stack((values, 10 * np.log10(power / per_m2[found])))
    return reported[inside], cells.actor[found][inside]


def _false_alarms(radar: Radar, rain_mm_h: float, rng: np.random.Generator) -> Array:
    """Return (M, 5) reports of cells where nothing but noise exceeds the threshold."""
    low, high = radar.extent().T
    cells = np.prod(np.ceil((high - low) / radar.resolution()))
    count = rng.poisson(cells * radar.false_alarm_rate)
    values = rng.uniform(low, high, (count, 4))
    power = -np.log(radar.false_alarm_rate) + rng.standard_exponential(count)
    return np.column_stack((values, 10 * np.log10(power / _snr_per_m2(radar, values, rain_mm_h))))
