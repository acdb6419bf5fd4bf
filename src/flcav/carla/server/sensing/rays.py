"""CARLA's LiDARs and its radar: points in the sensor's left-handed frame.

A LiDAR fires points_per_second over its channels, from the highest, evenly over the angle that it turns by in the time
since its last sweep. Its intensity is exp(-a distance), and it loses returns as in `flcav.sensors.lidar.beams`. The
radar's rays are random within its field of view; each gives the range rate of what it meets.
"""

import numpy as np
from numpy.typing import NDArray

from flcav.carla.frames import mirror
from flcav.carla.server.sensing.sight import Sensor, Sight
from flcav.carla.server.wire import SEMANTIC_POINT, pack_sweep
from flcav.geometry import unit_vectors
from flcav.sensors.lidar.beams import CarlaReturns, carla_returns
from flcav.world.rays.hits import Hits

MOST_RAYS = 4_000_000  # of one sweep


def sense_lidar(sight: Sight, sensor: Sensor) -> bytes:
    """Return the sweep of a LiDAR: x, y, z [m] and intensity."""
    directions, channels = _fire(sensor)
    hits = sight.cast(sensor, directions, sensor.number_of("range"))
    rng = sight.draw(sensor)
    settings = CarlaReturns(
        atmosphere_attenuation_rate=sensor.number_of("atmosphere_attenuation_rate"),
        dropoff_general_rate=sensor.number_of("dropoff_general_rate"),
        dropoff_intensity_limit=max(sensor.number_of("dropoff_intensity_limit"), 1e-6),
        dropoff_zero_intensity=sensor.number_of("dropoff_zero_intensity"),
    )
    noise = sensor.number_of("noise_stddev")
    error_m = np.float32(noise) * rng.standard_normal(len(directions), np.float32) if noise else np.zeros(1, np.float32)
    points, rays = carla_returns(settings, directions, hits.distance, np.broadcast_to(error_m, len(directions)), rng)
    points[:, :3] = mirror(points[:, :3])
    return _pack(sensor, channels, rays, points.astype("<f4"))


def sense_semantic_lidar(sight: Sight, sensor: Sensor) -> bytes:
    """Return the sweep of a semantic LiDAR: x, y, z [m], cosine of incidence, actor and tag."""
    directions, channels = _fire(sensor)
    hits = sight.cast(sensor, directions, sensor.number_of("range"))
    rays = np.flatnonzero(np.isfinite(hits.distance))
    met = Hits(hits.distance[rays], hits.instance[rays], hits.face[rays])
    points = np.empty(len(rays), SEMANTIC_POINT)
    points["xyz"] = mirror(directions[rays] * met.distance[:, None])
    points["cosine"] = _incidence(sight, sensor, directions[rays], met)
    points["actor"], points["tag"] = sight.numbers(met), sight.tags(met)
    return _pack(sensor, channels, rays, points)


def sense_radar(sight: Sight, sensor: Sensor) -> bytes:
    """Return the detections of a radar: range rate [m/s], azimuth, altitude [rad] and depth [m]."""
    rng = sight.draw(sensor)
    count = min(max(1, round(sensor.number_of("points_per_second") * sensor.elapsed_s)), MOST_RAYS)
    wide, high = (
        np.tan(np.radians(min(sensor.number_of(name), 179.0)) / 2) for name in ("horizontal_fov", "vertical_fov")
    )
    radius, angle = np.sqrt(rng.random(count)), rng.random(count) * 2 * np.pi
    azimuth = np.arctan(radius * np.cos(angle) * wide)  # to the right
    altitude = np.arctan(radius * np.sin(angle) * high)
    directions = unit_vectors(-azimuth, altitude).astype(np.float32)
    hits = sight.cast(sensor, directions, sensor.number_of("range"))
    rays = np.flatnonzero(np.isfinite(hits.distance))
    line = directions[rays] @ sensor.pose[:3, :3].T
    moving = np.concatenate((np.zeros((1, 3)), np.nan_to_num(sight.scene.trace.velocity[0])))[hits.instance[rays]]
    rate = ((moving - sensor.velocity) * line).sum(axis=1)
    return np.column_stack((rate, azimuth[rays], altitude[rays], hits.distance[rays])).astype("<f4").tobytes()


def _fire(sensor: Sensor) -> tuple[NDArray[np.float32], int]:
    """Return the rays of a sweep (channels * columns, 3), channel after channel, and the number of channels."""
    channels, field = int(sensor.number_of("channels")), sensor.number_of("horizontal_fov")
    columns = _count_columns(sensor, channels)
    turn = sensor.number_of("rotation_frequency") * field * sensor.elapsed_s
    azimuth = (sensor.azimuth_deg + np.arange(columns) * turn / columns) % field - field / 2
    sensor.azimuth_deg = round(float(sensor.azimuth_deg + turn), 6) % field
    elevation = np.linspace(sensor.number_of("upper_fov"), sensor.number_of("lower_fov"), channels)
    rays = unit_vectors(-np.radians(azimuth)[None], np.radians(elevation)[:, None])  # it turns to the right
    return rays.reshape(-1, 3).astype(np.float32), channels


def _count_columns(sensor: Sensor, channels: int) -> int:
    """Return the number of rays of each channel in a sweep; halves are rounded up, as CARLA does."""
    wanted = int(sensor.number_of("points_per_second") * sensor.elapsed_s / channels + 0.5 + 1e-6)
    return min(max(1, wanted), MOST_RAYS // channels)


def _incidence(sight: Sight, sensor: Sensor, directions: NDArray[np.float32], met: Hits) -> NDArray[np.float32]:
    """Return the cosine of the angle of incidence of each hit."""
    surfaces = sight.scene.surfaces
    normal = surfaces.normal[surfaces.first[met.instance] + met.face]
    turn = (sensor.pose[:3, :3].T @ sight.scene.world_from_instance()).astype(np.float32)
    return np.abs(np.einsum("nij,nj,ni->n", turn[met.instance], normal, directions))


def _pack(sensor: Sensor, channels: int, rays: NDArray[np.int64], points: NDArray) -> bytes:
    per_channel = np.bincount(rays // _count_columns(sensor, channels), minlength=channels)
    return pack_sweep(float(np.radians(sensor.azimuth_deg)), per_channel, points)
