"""Small synthetic LiDAR scenes by analytic ray casting: a ground plane, cars of body and cabin, clutter."""

import numpy as np

from flcav.geometry import Boxes
from flcav.perception.objects.samples import Sample

SENSOR_HEIGHT_M = 1.8


def spin(beams: int = 32, azimuths: int = 900, field_of_view_deg: float = 360.0) -> np.ndarray:
    """Return (R, 3) unit ray directions; `azimuths` are those of a full turn."""
    half = np.deg2rad(field_of_view_deg) / 2
    azimuth = np.arange(-half, half - 1e-9, 2 * np.pi / azimuths)
    elevation = np.deg2rad(np.linspace(-24.8, 2.0, beams))
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    return np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), -1).reshape(-1, 3)


def cast(rays: np.ndarray, boxes: np.ndarray, range_m: float = 80.0) -> tuple[np.ndarray, np.ndarray]:
    """Return (R,) distance (inf for none) and (R,) index of the hit box (M for the ground, -1 for none)."""
    with np.errstate(divide="ignore"):
        distance = np.where(rays[:, 2] < -1e-4, -SENSOR_HEIGHT_M / rays[:, 2], np.inf)
    distance = np.where(distance < range_m, distance, np.inf)
    hit = np.where(np.isfinite(distance), len(boxes), -1)
    for index, (x, y, z, length, width, height, yaw) in enumerate(boxes):
        facing = np.flatnonzero(rays[:, :2] @ np.array([x, y]) > 0)
        cos, sin = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        direction = rays[facing] @ turn
        direction = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
        origin = -np.array([x, y, z]) @ turn
        half = np.array([length, width, height]) / 2
        one, other = (-half - origin) / direction, (half - origin) / direction
        enter, leave = np.minimum(one, other).max(1), np.maximum(one, other).min(1)
        nearer = (enter <= leave) & (enter > 0.5) & (enter < distance[facing])
        distance[facing[nearer]], hit[facing[nearer]] = enter[nearer], index
    return distance, hit


def toy_sample(seed: int, rays: np.ndarray, reach_m: float = 46.0, side_m: float = 22.0) -> Sample:
    """Return a scene of 3-7 cars and 4-8 pieces of clutter ahead; cars with at least 5 returns are labelled."""
    rng = np.random.default_rng(seed)
    cars = _place(rng, int(rng.integers(3, 8)), reach_m, side_m, car=True, taken=[])
    clutter = _place(rng, int(rng.integers(4, 9)), reach_m, side_m, car=False, taken=cars)
    parts = [part for car in cars for part in _car_parts(car)] + clutter
    owner = np.array([i // 2 for i in range(2 * len(cars))] + [-1] * (len(clutter) + 2))
    distance, hit = cast(rays, np.array(parts))
    seen = np.isfinite(distance) & (rng.random(len(rays)) > 0.05)
    far = distance[seen] + rng.normal(0, 0.02, seen.sum())
    of = owner[hit[seen]]
    intensity = np.clip(np.where(of >= 0, 0.5, 0.25) * np.exp(-far / 60) + rng.normal(0, 0.03, len(far)), 0, 1)
    points = np.concatenate((rays[seen] * far[:, None], intensity[:, None]), 1).astype(np.float32)
    returns = np.array([(of == i).sum() for i in range(len(cars))])
    boxes = Boxes.from_array(np.array(cars), "Car")
    return Sample(points, boxes[returns >= 5], boxes[(returns > 0) & (returns < 5)])


def _place(
    rng: np.random.Generator, count: int, reach_m: float, side_m: float, *, car: bool, taken: list[np.ndarray]
) -> list[np.ndarray]:
    placed: list[np.ndarray] = []
    for _ in range(20 * count):
        if len(placed) == count:
            break
        x, y = rng.uniform(4, reach_m), rng.uniform(-side_m, side_m)
        if car:
            size = rng.normal([4.3, 1.8, 1.55], [0.25, 0.06, 0.08])
            yaw = rng.choice([0, np.pi, np.pi / 2, -np.pi / 2]) + rng.normal(0, 0.15)
        else:
            size = np.array([rng.uniform(0.3, 3), rng.uniform(0.3, 1), rng.uniform(0.6, 4)])
            yaw = rng.uniform(-np.pi, np.pi)
        box = np.array([x, y, size[2] / 2 - SENSOR_HEIGHT_M, *size, yaw])
        radius = np.hypot(*size[:2]) / 2
        others = taken + placed
        if np.hypot(x, y) > 4 + radius and all(
            np.hypot(x - o[0], y - o[1]) > radius + np.hypot(o[3], o[4]) / 2 for o in others
        ):
            placed.append(box)
    return placed


def _car_parts(car: np.ndarray) -> list[np.ndarray]:
    """Return body and cabin, which sits towards the rear, so that the heading shows."""
    x, y, z, length, width, height, yaw = car
    floor = z - height / 2
    back = 0.08 * length
    body = np.array([x, y, floor + 0.15 + 0.275 * height, length, width, 0.55 * height, yaw])
    cabin = [x - back * np.cos(yaw), y - back * np.sin(yaw), floor + 0.8 * height, 0.55 * length, 0.9 * width]
    return [body, np.array([*cabin, 0.4 * height, yaw])]
