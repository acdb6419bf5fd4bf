"""Simulation of a 77 GHz radar: ray casting, cross-sections, resolution cells, detection and false alarms.

Only direct echoes of the first surface are modelled: no multipath over the road, nothing behind glass.
"""

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import unit_vectors
from flcav.sensors.radar.detector import (
    Array,
    Radar,
    compute_actor_rcs,
    compute_town_rcs,
    detect,
    false_alarms,
    resolve,
    silhouette,
)
from flcav.world.rays.hits import Hits
from flcav.world.scene import Scene
from flcav.world.weather import Weather

RAYS_PER_CELL = 3  # along azimuth, and as many along elevation
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
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the detections of one radar sweep, nearest first, and the actor of each.

    Detections (N, 5) are range [m], azimuth [rad, to the left], elevation [rad, upwards], Doppler [m/s, positive where
    the distance grows] and radar cross-section [dBsm]. Actors (N,) are the trace's, by the largest share of the echo;
    -1 for the town and for false alarms. `velocity` (3,) is the radar's [m/s, world frame], `hidden` the carrier.
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
    cells = resolve(values, sigma, hits.instance - 1, radar)
    rain = weather.rain_mm_h if weather else 0.0
    measured, actor = detect(cells, radar, rain, rng)
    alarms = false_alarms(radar, rain, rng)
    everything = np.concatenate((measured, alarms)).astype(np.float32)
    owner = np.concatenate((actor, np.full(len(alarms), -1))).astype(np.int32)
    order = np.argsort(everything[:, 0], kind="stable")
    return everything[order], owner[order]


def compute_echo_directions(echoes: NDArray[np.float32]) -> Array:
    """Return (N, 3) unit vectors from the radar to the detections (N, 5) of a sweep, radar frame."""
    azimuth, elevation = echoes[:, 1:3].T.astype(np.float64)
    return unit_vectors(azimuth, elevation)


def draw_rays(radar: Radar, rng: np.random.Generator) -> tuple[NDArray[np.float32], Array]:
    """Return N unit rays (N, 3), one at random in each cell of a grid over the field of view, and cells' (N,) [sr]."""
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

    `ahead` (N, 3) are the rays in the radar's frame, `solid_angle` (N,) [sr] what each stands for: its patch has the
    projected area solid angle * distance^2.
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
    category, size = scene.trace.category[seen], scene.trace.size[seen]
    per_area[moving] = (compute_actor_rcs(category, aspect) / silhouette(size, aspect))[which]
    return per_area * solid_angle * hits.distance.astype(np.float64) ** 2


def _range_rates(
    scene: Scene, world_from_radar: Array, ahead: Array, hits: Hits, velocity: Array, rng: np.random.Generator
) -> Array:
    """Return (N,) range rates [m/s] of the surface points that N rays hit, positive where the distance grows."""
    trace, index = scene.trace, scene.index
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
