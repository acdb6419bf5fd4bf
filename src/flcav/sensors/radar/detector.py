"""A radar's detector: radar cross-sections, and peaks above the noise."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config
from flcav.world.materials import Material
from flcav.world.trace import CATEGORIES

Array = NDArray[np.float64]


class Echo(NamedTuple):
    """How a class of actor answers."""

    mean_dbsm: float
    flash_db: float  # above the mean, from straight ahead, behind and either side
    end_db: float  # above the sides, from ahead and behind


ECHOES: dict[str, Echo] = {
    "car": Echo(8.0, 9.0, -3.0),
    "van": Echo(11.0, 10.0, -3.0),
    "truck": Echo(16.0, 12.0, -4.0),
    "bus": Echo(17.0, 13.0, -5.0),
    "motorcycle": Echo(2.0, 4.0, -3.0),
    "bicycle": Echo(-3.0, 4.0, -4.0),
    "pedestrian": Echo(-8.0, 1.0, 1.5),
}
FLASH = 24.0  # exponent of the cosine: a flash is about 25 degrees wide at half power

LYING = (Material.GROUND, Material.ROAD, Material.SIDEWALK)
TOWN_DB: dict[Material, float] = {
    Material.GROUND: -20.0,  # of the lying: gamma
    Material.ROAD: -30.0,
    Material.SIDEWALK: -28.0,
    Material.WALL: -10.0,  # of the others: per square metre of their silhouette, from the side
    Material.ROOF: -10.0,
    Material.BARK: -8.0,
    Material.LEAF: -14.0,
    Material.METAL: 2.0,
    Material.SIGN: 4.0,
}
ELSE_DB = -5.0
GLINT_DB = 20.0  # by which a flat face is brighter face on
GLINT = 40.0

_TOWN = 10 ** (np.array([TOWN_DB.get(material, ELSE_DB) for material in Material]) / 10)
_LIES = np.array([material in LYING for material in Material])
_ACTOR = np.array([ECHOES[category] for category in CATEGORIES])


def actor_rcs(category: NDArray[np.str_], aspect: Array) -> Array:
    """Return (K,) radar cross-sections [m^2] of whole actors, seen from `aspect` [rad] counter-clockwise of ahead."""
    mean, flash, end = _ACTOR[[CATEGORIES.index(str(name)) for name in category]].reshape(-1, 3).T
    ahead, aside = np.abs(np.cos(aspect)) ** FLASH, np.abs(np.sin(aspect)) ** FLASH
    return 10 ** ((mean + flash * (ahead + aside) + end * np.cos(aspect) ** 2) / 10)


def silhouette(size: Array, aspect: Array) -> Array:
    """Return (K,) areas [m^2] of boxes of `size` (K, 3) seen level from `aspect` [rad]."""
    length, width, height = size.T
    return (length * np.abs(np.sin(aspect)) + width * np.abs(np.cos(aspect))) * height


def town_rcs_per_area(material: NDArray[np.uint8], cosine: Array) -> Array:
    """Return (K,) m^2 per square metre of silhouette of the town's surfaces, met at an incidence of that `cosine`."""
    glint = 1 + (10 ** (GLINT_DB / 10) - 1) * cosine**GLINT
    return _TOWN[material] * np.where(_LIES[material], 1.0, glint)


REFERENCE_M2 = 10.0  # of the target that `detects_car_m` speaks of
EDGE_DB = 6.0  # two-way gain at the edge of the field of view, below that ahead
SPLIT = 1.6  # how many times finer than a cell a value is read at a signal-to-noise ratio of 1/2 (Barton)
RAIN_DB = (1.13, 0.718)  # k, a of k R^a [dB/km] at 77 GHz: ITU-R P.838-3


class Radar(Config):
    """What a radar is built like; the defaults are those of a front radar of a car."""

    range_m: float = Field(default=120.0, ge=0.1, le=500)  # nothing further off is reported
    azimuth_deg: float = Field(default=120.0, ge=0.1, le=170)  # field of view from side to side
    elevation_deg: float = Field(default=20.0, ge=0.1, le=90)  # field of view from bottom to top
    speed_m_s: float = Field(default=70.0, ge=0.1, le=1000)  # Doppler measured up to here, either way
    range_cell_m: float = Field(default=0.4, ge=0.01, le=100)  # what is nearer together is one detection
    azimuth_cell_deg: float = Field(default=2.0, ge=0.01, le=90)  # likewise
    elevation_cell_deg: float = Field(default=5.0, ge=0.01, le=90)  # likewise
    doppler_cell_m_s: float = Field(default=0.2, ge=0.001, le=100)  # likewise
    detects_car_m: float = Field(
        default=150.0, ge=0.1, le=1e4
    )  # 10 dBsm ahead are detected half the time at this range
    false_alarm_rate: float = Field(default=3e-7, ge=1e-15, lt=0.1)  # chance of one in one cell of a sweep

    def resolution(self) -> Array:
        """Return (4,) a cell's range [m], azimuth [rad], elevation [rad] and Doppler [m/s]."""
        angles = np.radians((self.azimuth_cell_deg, self.elevation_cell_deg))
        return np.array((self.range_cell_m, *angles, self.doppler_cell_m_s))

    def extent(self) -> Array:
        """Return (4, 2) lowest and highest range [m], azimuth [rad], elevation [rad] and Doppler [m/s]."""
        azimuth, elevation = np.radians((self.azimuth_deg, self.elevation_deg)) / 2
        limits = ((0.0, self.range_m), (-azimuth, azimuth), (-elevation, elevation), (-self.speed_m_s, self.speed_m_s))
        return np.array(limits)


class Cells(NamedTuple):
    """What the resolution cells that hold anything hold."""

    values: Array  # (C, 4) range, azimuth, elevation, Doppler: means weighted by cross-section
    sigma: Array  # (C,) [m^2]
    actor: NDArray[np.int64]  # (C,) the loudest; -1 for the town


def resolve(values: Array, sigma: Array, actor: NDArray[np.int32], radar: Radar) -> Cells:
    """Return the cells in which echoes fall: (N, 4) range, azimuth, elevation, Doppler, (N,) [m^2] and (N,) actors."""
    low = radar.extent()[:, 0]
    key = np.floor((values - low) / radar.resolution()).astype(np.int64)
    order = np.lexsort((-sigma, *key.T))  # the loudest of a cell first
    values, sigma, key = values[order], sigma[order], key[order]
    fresh = np.ones(len(key), bool)
    fresh[1:] = (key[1:] != key[:-1]).any(axis=1)
    starts = np.flatnonzero(fresh)
    total = np.add.reduceat(sigma, starts) if len(starts) else sigma
    weighted = np.add.reduceat(values * sigma[:, None], starts) if len(starts) else values
    return Cells(weighted / np.maximum(total, 1e-30)[:, None], total, actor[order][starts].astype(np.int64))


def snr_per_m2(radar: Radar, values: Array, rain_mm_h: float) -> Array:
    """Return (N,) the signal-to-noise ratio of 1 m^2 at `values` (N, >=3) range, azimuth, elevation."""
    threshold = -np.log(radar.false_alarm_rate)
    at_reference = threshold / np.log(2) - 1  # detected half the time
    gain_db = -EDGE_DB * ((values[:, 1:3] / radar.extent()[1:3, 1]) ** 2).sum(axis=1)
    distance = np.maximum(values[:, 0], radar.range_cell_m)
    k, a = RAIN_DB
    loss_db = 2 * distance / 1e3 * k * rain_mm_h**a
    return at_reference / REFERENCE_M2 * (radar.detects_car_m / distance) ** 4 * 10 ** ((gain_db - loss_db) / 10)


def detect(cells: Cells, radar: Radar, rain_mm_h: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Return (M, 5) what is reported of the cells that are detected, and (M,) their actors."""
    per_m2 = snr_per_m2(radar, cells.values, rain_mm_h)
    power = (1 + per_m2 * cells.sigma) * rng.standard_exponential(len(per_m2))
    found = power > -np.log(radar.false_alarm_rate)
    power = power[found]
    values = cells.values[found]
    values = values + rng.standard_normal(values.shape) * radar.resolution() / (SPLIT * np.sqrt(2 * power))[:, None]
    low, high = radar.extent().T
    inside = ((values >= low) & (values <= high)).all(axis=1)
    reported = np.column_stack((values, 10 * np.log10(power / per_m2[found])))
    return reported[inside], cells.actor[found][inside]


def false_alarms(radar: Radar, rain_mm_h: float, rng: np.random.Generator) -> Array:
    """Return (M, 5) reports of cells where nothing but noise exceeds the threshold."""
    low, high = radar.extent().T
    cells = np.prod(np.ceil((high - low) / radar.resolution()))
    count = rng.poisson(cells * radar.false_alarm_rate)
    values = rng.uniform(low, high, (count, 4))
    power = -np.log(radar.false_alarm_rate) + rng.standard_exponential(count)
    return np.column_stack((values, 10 * np.log10(power / snr_per_m2(radar, values, rain_mm_h))))
