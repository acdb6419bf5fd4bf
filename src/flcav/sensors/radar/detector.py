"""Radar cross-sections at 77 GHz, and a Swerling 1 detector over resolution cells.

Mean cross-sections of actors are those commonly measured at 76 to 81 GHz (pedestrian -8 dBsm: Yamada et al., 2005; cars
10 dBsm with flashes off flat front, rear and sides: Schipper et al., 2011). An actor's cross-section is spread evenly
over its silhouette, so that a car of which half is hidden has half of it. Ground follows the constant-gamma model of
land clutter.

The radar equation gives each cell's signal-to-noise ratio, S = K g(direction) sigma L(rain) / r^4, with g the two-way
antenna gain and sigma the cross-section. A cell fluctuates as Swerling's case 1: its measured power, in units of the
noise, is exponential with mean 1 + S and is reported above T = -ln(P_fa); so the probability of detection is
P_fa^(1 / (1 + S)) (Richards, "Fundamentals of Radar Signal Processing", section 6.3). Errors of a reported value shrink
with the square root of the power.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import Config
from flcav.world.materials import Material
from flcav.world.trace import CATEGORIES

Array = NDArray[np.float64]
FLASH = 24.0  # exponent of the cosine of a flash's angle: about 27 degrees wide at half its decibels
LYING = (Material.GROUND, Material.ROAD, Material.SIDEWALK)  # horizontal surfaces: constant-gamma clutter
TOWN_DB: dict[Material, float] = {
    Material.GROUND: -20.0,  # of horizontal surfaces: gamma
    Material.ROAD: -30.0,
    Material.SIDEWALK: -28.0,
    Material.WALL: -10.0,  # of others: cross-section per square metre of silhouette, at grazing incidence
    Material.ROOF: -10.0,
    Material.BARK: -8.0,
    Material.LEAF: -14.0,
    Material.METAL: 2.0,
    Material.SIGN: 4.0,
}
ELSE_DB = -5.0  # of all other materials
GLINT_DB = 20.0  # specular gain of a flat face at normal incidence
GLINT = 40.0  # exponent of the cosine of incidence
_TOWN = 10 ** (np.array([TOWN_DB.get(material, ELSE_DB) for material in Material]) / 10)
_LIES = np.array([material in LYING for material in Material])
REFERENCE_M2 = 10.0  # cross-section of the target in the definition of `detects_car_m`
EDGE_DB = 6.0  # two-way gain at the edge of the field of view, below that ahead
SPLIT = 1.6  # cell size over the standard deviation of a value, at a signal-to-noise ratio of 1/2 (Barton)
RAIN_DB = (1.13, 0.718)  # k, a of k R^a [dB/km] at 77 GHz: ITU-R P.838-3


class AspectRcs(NamedTuple):
    """Radar cross-section of a class of actors, by aspect."""

    mean_dbsm: float  # level without flashes, seen from the side
    flash_db: float  # gain of specular flashes straight ahead, behind and to either side
    end_db: float  # level seen from ahead and behind, over that from the side


ACTOR_RCS: dict[str, AspectRcs] = {
    "car": AspectRcs(8.0, 9.0, -3.0),
    "van": AspectRcs(11.0, 10.0, -3.0),
    "truck": AspectRcs(16.0, 12.0, -4.0),
    "bus": AspectRcs(17.0, 13.0, -5.0),
    "motorcycle": AspectRcs(2.0, 4.0, -3.0),
    "bicycle": AspectRcs(-3.0, 4.0, -4.0),
    "pedestrian": AspectRcs(-8.0, 1.0, 1.5),
}
PROP_RCS = AspectRcs(-5.0, 4.0, 0.0)
_CATEGORIES = (*CATEGORIES, "prop")
_ACTOR = np.array([*(ACTOR_RCS[category] for category in CATEGORIES), PROP_RCS])


def compute_actor_rcs(category: NDArray[np.str_], aspect: Array) -> Array:
    """Return (K,) mean radar cross-sections [m^2] of whole, unoccluded actors.

    `category` (K,) are their classes, `aspect` (K,) the direction to the radar [rad], counter-clockwise from ahead.
    """
    mean, flash, end = _ACTOR[[_CATEGORIES.index(str(name)) for name in category]].reshape(-1, 3).T
    ahead, aside = np.abs(np.cos(aspect)) ** FLASH, np.abs(np.sin(aspect)) ** FLASH
    return 10 ** ((mean + flash * (ahead + aside) + end * np.cos(aspect) ** 2) / 10)


def silhouette(size: Array, aspect: Array) -> Array:
    """Return (K,) projected areas [m^2] of boxes of `size` (K, 3) [m], seen horizontally from `aspect` (K,) [rad]."""
    length, width, height = size.T
    return (length * np.abs(np.sin(aspect)) + width * np.abs(np.cos(aspect))) * height


def compute_town_rcs(material: NDArray[np.uint8], cosine: Array) -> Array:
    """Return (K,) cross-sections per projected area of the town's surfaces, by material and `cosine` of incidence."""
    glint = 1 + (10 ** (GLINT_DB / 10) - 1) * cosine**GLINT
    return _TOWN[material] * np.where(_LIES[material], 1.0, glint)


class Radar(Config):
    """Settings of a radar; the defaults are those of a car's front radar."""

    range_m: float = Field(default=120.0, ge=0.1, le=500)  # maximum range; farther detections are not reported
    azimuth_deg: float = Field(default=120.0, ge=0.1, le=170)  # horizontal field of view
    elevation_deg: float = Field(default=20.0, ge=0.1, le=90)  # vertical field of view
    speed_m_s: float = Field(default=70.0, ge=0.1, le=1000)  # largest radial speed measured, either way
    range_cell_m: float = Field(default=0.4, ge=0.01, le=100)  # resolution of range
    azimuth_cell_deg: float = Field(default=2.0, ge=0.01, le=90)  # resolution of azimuth
    elevation_cell_deg: float = Field(default=5.0, ge=0.01, le=90)  # resolution of elevation
    doppler_cell_m_s: float = Field(default=0.2, ge=0.001, le=100)  # resolution of radial speed
    detects_car_m: float = Field(
        default=150.0, ge=0.1, le=1e4
    )  # range at which 10 dBsm straight ahead in clear air is detected with probability 1/2
    false_alarm_rate: float = Field(default=3e-7, ge=1e-15, lt=0.1)  # false alarms per resolution cell and sweep

    def resolution(self) -> Array:
        """Return a cell's size (4,): range [m], azimuth [rad], elevation [rad] and Doppler [m/s]."""
        angles = np.radians((self.azimuth_cell_deg, self.elevation_cell_deg))
        return np.array((self.range_cell_m, *angles, self.doppler_cell_m_s))

    def extent(self) -> Array:
        """Return the lowest and highest (4, 2) range [m], azimuth [rad], elevation [rad] and Doppler [m/s]."""
        azimuth, elevation = np.radians((self.azimuth_deg, self.elevation_deg)) / 2
        limits = ((0.0, self.range_m), (-azimuth, azimuth), (-elevation, elevation), (-self.speed_m_s, self.speed_m_s))
        return np.array(limits)


class Cells(NamedTuple):
    """The C resolution cells that hold any echo."""

    values: Array  # (C, 4) as in `Radar.extent`: means weighted by cross-section
    sigma: Array  # (C,) sum of the cross-sections [m^2]
    actor: NDArray[np.int64]  # (C,) that of the largest cross-section; -1 for the town


def resolve(values: Array, sigma: Array, actor: NDArray[np.int32], radar: Radar) -> Cells:
    """Return the resolution cells that hold N echoes, which are summed up by cell.

    `values` (N, 4) are range [m], azimuth [rad], elevation [rad] and Doppler [m/s] of the echoes, `sigma` (N,) their
    cross-sections [m^2], `actor` (N,) the actors they come from (-1: the town).
    """
    low = radar.extent()[:, 0]
    key = np.floor((values - low) / radar.resolution()).astype(np.int64)
    order = np.lexsort((-sigma, *key.T))  # the largest cross-section of a cell first
    values, sigma, key = values[order], sigma[order], key[order]
    fresh = np.ones(len(key), bool)
    fresh[1:] = (key[1:] != key[:-1]).any(axis=1)
    starts = np.flatnonzero(fresh)
    total = np.add.reduceat(sigma, starts) if len(starts) else sigma
    weighted = np.add.reduceat(values * sigma[:, None], starts) if len(starts) else values
    return Cells(weighted / np.maximum(total, 1e-30)[:, None], total, actor[order][starts].astype(np.int64))


def snr_per_m2(radar: Radar, values: Array, rain_mm_h: float) -> Array:
    """Return (N,) signal-to-noise ratios of 1 m^2 at `values` (N, >=3) range, azimuth, elevation: the radar equation.

    Calibrated such that REFERENCE_M2 straight ahead is detected half the time at `detects_car_m` in clear air. Rain
    attenuates both ways.
    """
    threshold = -np.log(radar.false_alarm_rate)
    at_reference = threshold / np.log(2) - 1  # at which the probability of detection is 1/2
    gain_db = -EDGE_DB * ((values[:, 1:3] / radar.extent()[1:3, 1]) ** 2).sum(axis=1)
    distance = np.maximum(values[:, 0], radar.range_cell_m)
    k, a = RAIN_DB
    loss_db = 2 * distance / 1e3 * k * rain_mm_h**a
    return at_reference / REFERENCE_M2 * (radar.detects_car_m / distance) ** 4 * 10 ** ((gain_db - loss_db) / 10)


def detect(cells: Cells, radar: Radar, rain_mm_h: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Return the detections (M, 5) among `cells` and their actors (M,).

    A detection is range [m], azimuth [rad], elevation [rad], Doppler [m/s], all with errors, and cross-section [dBsm].
    Those measured outside the radar's extent are left out.
    """
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
    """Return M false alarms (M, 5), columns as in `detect`: cells whose noise alone exceeds the threshold (Poisson)."""
    low, high = radar.extent().T
    cells = np.prod(np.ceil((high - low) / radar.resolution()))
    count = rng.poisson(cells * radar.false_alarm_rate)
    values = rng.uniform(low, high, (count, 4))
    power = -np.log(radar.false_alarm_rate) + rng.standard_exponential(count)
    return np.column_stack((values, 10 * np.log10(power / snr_per_m2(radar, values, rain_mm_h))))
