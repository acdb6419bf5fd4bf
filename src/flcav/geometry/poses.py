"""Rigid transforms as 4x4 homogeneous matrices, named `target_from_source`: a_from_c = a_from_b @ b_from_c.

World frame: ENU (x east, y north, z up) [m]. Body frame: x forward, y left, z up. Yaw is counter-clockwise from east
[rad].
"""

import math
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flcav.arrays import Array

Coordinate = TypeVar("Coordinate", float, Array)


def pose(x: float, y: float, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """Return the (4, 4) `world_from_body` of a body from its position and its Tait-Bryan angles.

    Intrinsic z-y'-x'' rotation.

    Args:
        x: position to the east [m].
        y: position to the north [m].
        z: height [m].
        yaw: heading, counter-clockwise from x [rad].
        pitch: inclination; positive turns the nose down [rad] (right-hand rule about the left axis).
        roll: bank; positive turns the right side down [rad].
    """
    cy, sy, cp, sp, cr, sr = (np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def inverse(target_from_source: Array) -> Array:
    """Return the inverse (4, 4) `source_from_target` of a rigid transform, by the transpose of its rotation."""
    rotation = target_from_source[:3, :3].T
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = -rotation @ target_from_source[:3, 3]
    return out


def is_rigid(target_from_source: Array) -> bool:
    """Return whether a (4, 4) matrix is a rigid transform: a proper rotation, to 1e-6, and a translation."""
    rotation = target_from_source[:3, :3]
    return bool(
        np.isfinite(target_from_source).all()
        and np.abs(rotation).max() < 2  # first, since products of huge numbers overflow
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        and np.linalg.det(rotation) > 0
        and np.array_equal(target_from_source[3], (0, 0, 0, 1))
    )


def heading_vectors(yaw: ArrayLike) -> Array:
    """Return (..., 2) unit vectors x, y of the headings `yaw` (...) [rad]."""
    return np.stack((np.cos(yaw), np.sin(yaw)), axis=-1)


def left_vectors(yaw: ArrayLike) -> Array:
    """Return (..., 2) unit vectors x, y that point to the left of the headings `yaw` (...) [rad]."""
    return np.stack((-np.sin(yaw), np.cos(yaw)), axis=-1)


def unit_vectors(azimuth: ArrayLike, elevation: ArrayLike) -> Array:
    """Return (..., 3) unit vectors x, y, z of spherical coordinates, which broadcast together.

    `azimuth` [rad] is counter-clockwise from x in the x-y plane, `elevation` [rad] the angle above it.
    """
    level = np.cos(elevation)
    parts = np.broadcast_arrays(level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
    return np.stack(parts, axis=-1)


def rotations_about_z(yaw: ArrayLike) -> Array:
    """Return (..., 3, 3) rotation matrices by `yaw` (...) [rad] about z."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    rows = ((cos, -sin, zero), (sin, cos, zero), (zero, zero, one))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotations(yaw: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> Array:
    """Return (..., 3, 3) rotation matrices by Tait-Bryan angles (...) [rad], as in `pose`."""
    sy, cy, sp, cp, sr, cr = (wave(angle) for angle in (yaw, pitch, roll) for wave in (np.sin, np.cos))
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in rows], axis=-2)


def angles_of(rotation: Array) -> tuple[Array, Array, Array]:
    """Return yaw, pitch and roll (...) [rad] of rotation matrices (..., 3, 3): the inverse of `rotations`."""
    forward = rotation[..., :, 0]
    pitch = np.arctan2(-forward[..., 2], np.hypot(forward[..., 0], forward[..., 1]))
    return np.arctan2(forward[..., 1], forward[..., 0]), pitch, np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])


def rotate(x: Coordinate, y: Coordinate, yaw: float) -> tuple[Coordinate, Coordinate]:
    """Rotate plane vectors x, y by `yaw` [rad], counter-clockwise: from the body frame to the frame of its heading.

    Rotating by -`yaw` is the inverse: it gives the components forward and to the left of the body.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    return x * cos - y * sin, x * sin + y * cos


def yaw_of(target_from_source: Array) -> float:
    """Return the yaw [rad] of a (4, 4) transform: the heading of the source's x axis in the target's x-y plane."""
    return float(np.arctan2(target_from_source[1, 0], target_from_source[0, 0]))


def transform_points(target_from_source: Array, points: ArrayLike) -> NDArray:
    """Return (N, 3) `points` of the source frame in the target frame, in their dtype."""
    points = np.asarray(points)
    moved = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    return moved.astype(points.dtype, copy=False)


def wrap_angle(angle: ArrayLike) -> Array:
    """Return angles [rad] wrapped to [-pi, pi)."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi
