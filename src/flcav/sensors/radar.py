"""Simulation of a 77 GHz radar: ray casting, cross-sections, resolution cells, detection and false alarms.

Only direct echoes of the first surface are modelled: no multipath over the road, nothing behind glass.

Mean radar cross-sections of actors are those commonly measured at 76 to 81 GHz (pedestrian -8 dBsm: Yamada et al.,
2005; cars 10 dBsm with flashes off flat front, rear and sides: Schipper et al., 2011). An actor's cross-section is
spread evenly over its silhouette, so that a half-occluded car has half of it. Ground follows the constant-gamma model
of land clutter.

The radar equation gives the signal-to-noise ratio of a resolution cell, S = K g(direction) sigma L(rain) / r^4, with g
the two-way antenna gain and sigma the cross-section. A cell fluctuates as Swerling's case 1: its measured power, in
units of the noise, is exponential with mean 1 + S and is reported above T = -ln(P_fa); so the probability of detection
is P_fa^(1 / (1 + S)) (Richards, "Fundamentals of Radar Signal Processing", section 6.3). Errors of a reported value
decrease with the square root of the power.
"""

from typing import NamedTuple

import numpy as np
from pydantic import Field

from flcav.arrays import Array, Array32, Bytes, Ints, Ints32, Words
from flcav.config import Config
from flcav.geometry import unit_vectors
from flcav.world.materials import Material
from flcav.world.rays.packets import Hits
from flcav.world.scene import Scene
from flcav.world.trace import CATEGORIES
from flcav.world.weather import Weather

FLASH = 24.0  # exponent of the cosine of a flash's angle: about 27 degrees wide at half of its decibels
LYING = (Material.GROUND, Material.ROAD, Material.SIDEWALK)  # horizontal surfaces: constant-gamma clutter
TOWN_DB: dict[Material, float] = {
    Material.GROUND: -20.0,  # horizontal surfaces: gamma
    Material.ROAD: -30.0,
    Material.SIDEWALK: -28.0,
    Material.WALL: -10.0,  # of others: cross-section per projected area, at grazing incidence
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
EDGE_DB = 6.0  # loss of two-way gain at the edge of the field of view, relative to straight ahead
SPLIT = 1.6  # cell size over the standard deviation of a value, at a signal-to-noise ratio of 1/2 (Barton)
RAIN_DB = (1.13, 0.718)  # k, a of k R^a [dB/km] at 77 GHz: ITU-R P.838-3


class AspectRcs(NamedTuple):
    """Radar cross-section of a class of actors, by aspect angle."""

    mean_dbsm: float  # level without flashes, from the side [dBsm]
    flash_db: float  # gain of specular flashes straight ahead, behind and to either side [dB]
    end_db: float  # level from ahead and behind, relative to that from the side [dB]


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


def compute_actor_rcs(category: Words, aspect: Array) -> Array:
    """Return (K,) mean radar cross-sections [m^2] of unoccluded actors.

    `category` (K,) are their classes, `aspect` (K,) the directions to the radar [rad], counter-clockwise from ahead.
    """
    mean, flash, end = _ACTOR[[_CATEGORIES.index(str(name)) for name in category]].reshape(-1, 3).T
    ahead, aside = np.abs(np.cos(aspect)) ** FLASH, np.abs(np.sin(aspect)) ** FLASH
    return 10 ** ((mean + flash * (ahead + aside) + end * np.cos(aspect) ** 2) / 10)


def silhouette(size: Array, aspect: Array) -> Array:
    """Return (K,) projected areas [m^2] of boxes of `size` (K, 3) [m] at horizontal aspect angles (K,) [rad]."""
    length, width, height = size.T
    return (length * np.abs(np.sin(aspect)) + width * np.abs(np.cos(aspect))) * height


def compute_town_rcs(material: Bytes, cosine: Array) -> Array:
    """Return (K,) cross-sections per projected area of the town's surfaces, by material and cosine of incidence."""
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
        """Return the size of a resolution cell (4,): range [m], azimuth [rad], elevation [rad] and Doppler [m/s]."""
        angles = np.radians((self.azimuth_cell_deg, self.elevation_cell_deg))
        return np.array((self.range_cell_m, *angles, self.doppler_cell_m_s))

    def extent(self) -> Array:
        """Return the lowest and highest (4, 2) range [m], azimuth [rad], elevation [rad] and Doppler [m/s]."""
        azimuth, elevation = np.radians((self.azimuth_deg, self.elevation_deg)) / 2
        limits = ((0.0, self.range_m), (-azimuth, azimuth), (-elevation, elevation), (-self.speed_m_s, self.speed_m_s))
        return np.array(limits)


class Cells(NamedTuple):
    """The C resolution cells that contain an echo."""

    values: Array  # (C, 4) range [m], azimuth, elevation [rad], Doppler [m/s]: means weighted by cross-section
    sigma: Array  # (C,) sum of the cross-sections [m^2]
    actor: Ints  # (C,) actor with the largest cross-section; -1 for the town


def resolve_cells(values: Array, sigma: Array, actor: Ints32, radar: Radar) -> Cells:
    """Sum N echoes by resolution cell, and return the cells.

    `values` (N, 4) are range [m], azimuth [rad], elevation [rad] and Doppler [m/s] of the echoes, radar frame, `sigma`
    (N,) their cross-sections [m^2], `actor` (N,) the actors they come from (-1: the town).
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
    """Return (N,) signal-to-noise ratios of 1 m^2 at `values` (N, >=3) range [m], azimuth, elevation [rad].

    By the radar equation, calibrated such that REFERENCE_M2 straight ahead is detected with probability 1/2 at
    `detects_car_m` in clear air. Rain [mm/h] attenuates both ways.
    """
    threshold = -np.log(radar.false_alarm_rate)
    at_reference = threshold / np.log(2) - 1  # at which the probability of detection is 1/2
    gain_db = -EDGE_DB * ((values[:, 1:3] / radar.extent()[1:3, 1]) ** 2).sum(axis=1)
    distance = np.maximum(values[:, 0], radar.range_cell_m)
    k, a = RAIN_DB
    loss_db = 2 * distance / 1e3 * k * rain_mm_h**a
    return at_reference / REFERENCE_M2 * (radar.detects_car_m / distance) ** 4 * 10 ** ((gain_db - loss_db) / 10)


def detect_cells(cells: Cells, radar: Radar, rain_mm_h: float, rng: np.random.Generator) -> tuple[Array, Ints]:
    """Detect echoes: return the detections (M, 5) among `cells` and their actors (M,).

    A detection is range [m], azimuth [rad], elevation [rad], Doppler [m/s], all with errors, and cross-section [dBsm].
    Detections measured outside the radar's extent are left out.
    """
    per_m2 = snr_per_m2(radar, cells.values, rain_mm_h)
    power = (1 + per_m2 * cells.sigma) * rng.standard_exponential(len(per_m2))
    detected = power > -np.log(radar.false_alarm_rate)
    power = power[detected]
    values = cells.values[detected]
    values = values + rng.standard_normal(values.shape) * radar.resolution() / (SPLIT * np.sqrt(2 * power))[:, None]
    low, high = radar.extent().T
    inside = ((values >= low) & (values <= high)).all(axis=1)
    reported = np.column_stack((values, 10 * np.log10(power / per_m2[detected])))
    return reported[inside], cells.actor[detected][inside]


def false_alarms(radar: Radar, rain_mm_h: float, rng: np.random.Generator) -> Array:
    """Draw false alarms (M, 5), with the columns of `detect_cells`: a Poisson number, at uniformly random places."""
    low, high = radar.extent().T
    cells = np.prod(np.ceil((high - low) / radar.resolution()))
    count = rng.poisson(cells * radar.false_alarm_rate)
    values = rng.uniform(low, high, (count, 4))
    power = -np.log(radar.false_alarm_rate) + rng.standard_exponential(count)
    return np.column_stack((values, 10 * np.log10(power / snr_per_m2(radar, values, rain_mm_h))))


RAYS_PER_CELL = 3  # in azimuth, and as many in elevation
LIMBS_M_S = {"pedestrian": 0.5, "bicycle": 0.5}  # standard deviation of limbs' speeds (micro-Doppler)


def sweep_radar(
    scene: Scene,
    world_from_radar: Array,
    velocity: Array,
    radar: Radar,
    rng: np.random.Generator,
    *,
    hidden: int | None = None,
    weather: Weather | None = None,
) -> tuple[Array32, Ints32]:
    """Simulate one radar sweep: return its detections, nearest first, and their actors.

    Detections (N, 5) are range [m], azimuth [rad, to the left], elevation [rad, upwards], radar frame, Doppler [m/s,
    positive for receding] and radar cross-section [dBsm]. Actors (N,) are rows of the trace, by the largest share of
    the echo; -1 for the town and for false alarms. `world_from_radar` (4, 4) [m] and `velocity` (3,) [m/s] are the
    radar's pose and velocity, world frame; `hidden` is the carrier.
    """
    directions, solid_angle = draw_rays(radar, rng)
    hits = scene.cast(world_from_radar, directions, far_m=radar.range_m, hidden=hidden)
    met = np.flatnonzero(hits.instance >= 0)
    hits = Hits(hits.distance[met], hits.instance[met], hits.face[met])
    ahead = directions[met].astype(np.float64)
    sigma = cross_sections(scene, world_from_radar, ahead, hits, solid_angle[met])
    speed = _range_rates(scene, world_from_radar, ahead, hits, velocity, rng)
    away = hits.distance.astype(np.float64)
    values = np.column_stack((away, np.arctan2(ahead[:, 1], ahead[:, 0]), np.arcsin(ahead[:, 2]), speed))
    cells = resolve_cells(values, sigma, hits.instance - 1, radar)
    rain = weather.rain_mm_h if weather else 0.0
    measured, actor = detect_cells(cells, radar, rain, rng)
    alarms = false_alarms(radar, rain, rng)
    everything = np.concatenate((measured, alarms)).astype(np.float32)
    owner = np.concatenate((actor, np.full(len(alarms), -1))).astype(np.int32)
    order = np.argsort(everything[:, 0], kind="stable")
    return everything[order], owner[order]


def compute_echo_directions(echoes: Array32) -> Array:
    """Return (N, 3) unit vectors from the radar to the detections (N, 5) of a sweep, radar frame."""
    azimuth, elevation = echoes[:, 1:3].T.astype(np.float64)
    return unit_vectors(azimuth, elevation)


def draw_rays(radar: Radar, rng: np.random.Generator) -> tuple[Array32, Array]:
    """Draw one unit ray per cell of a grid over the field of view: (N, 3), radar frame, and solid angles (N,) [sr]."""
    _, (left, right), (low, high), _ = radar.extent()
    _, azimuth_cell, elevation_cell, _ = radar.resolution()
    columns = int(np.ceil((right - left) / azimuth_cell * RAYS_PER_CELL))
    rows = int(np.ceil((high - low) / elevation_cell * RAYS_PER_CELL))
    row, column = np.divmod(np.arange(rows * columns), columns)
    azimuth = left + (column + rng.random(len(column))) * (right - left) / columns
    elevation = low + (row + rng.random(len(row))) * (high - low) / rows
    solid_angle = np.cos(elevation) * ((right - left) / columns) * ((high - low) / rows)
    return unit_vectors(azimuth, elevation).astype(np.float32), solid_angle


def cross_sections(scene: Scene, world_from_radar: Array, ahead: Array, hits: Hits, solid_angle: Array) -> Array:
    """Return (N,) radar cross-sections [m^2] of the surface patches that N rays hit.

    `ahead` (N, 3) are the unit rays, radar frame, `solid_angle` (N,) [sr] their shares of the field of view: a patch
    has the projected area solid angle * distance^2.
    """
    surfaces = scene.surfaces
    row = surfaces.first[hits.instance] + hits.face
    turn = world_from_radar[:3, :3].T @ scene.world_from_instance()
    normal = np.einsum("nij,nj->ni", turn[hits.instance], surfaces.normal[row].astype(np.float64))
    cosine = np.abs((normal * ahead).sum(axis=1))
    per_area = compute_town_rcs(surfaces.material[row], cosine)

    moving = hits.instance > 0
    seen, which = np.unique(hits.instance[moving] - 1, return_inverse=True)
    x, y, _, yaw = scene.poses()[seen].T
    aspect = np.arctan2(world_from_radar[1, 3] - y, world_from_radar[0, 3] - x) - yaw
    category = scene.trace.category[seen]
    size = scene.trace.size[seen]
    per_area[moving] = (compute_actor_rcs(category, aspect) / silhouette(size, aspect))[which]
    return per_area * solid_angle * hits.distance.astype(np.float64) ** 2


def _range_rates(
    scene: Scene, world_from_radar: Array, ahead: Array, hits: Hits, velocity: Array, rng: np.random.Generator
) -> Array:
    """Return (N,) range rates [m/s] of the surface points that N rays hit, positive for receding."""
    trace = scene.trace
    index = scene.index
    limbs = np.array([LIMBS_M_S.get(str(category), 0.0) for category in trace.category])
    line = ahead @ world_from_radar[:3, :3].T
    moving = np.flatnonzero(hits.instance > 0)
    actor = hits.instance[moving] - 1
    at = world_from_radar[:3, 3] + hits.distance[moving, None] * line[moving]
    arm = at - scene.poses()[actor, :3]
    spin = trace.yaw_rate[index, actor]
    swing = np.column_stack((-spin * arm[:, 1], spin * arm[:, 0], np.zeros(len(spin))))
    relative = np.tile(-velocity, (len(ahead), 1))
    relative[moving] += trace.velocity[index, actor] + swing
    rate = (relative * line).sum(axis=1)
    rate[moving] += limbs[actor] * rng.standard_normal(len(moving))
    return rate
