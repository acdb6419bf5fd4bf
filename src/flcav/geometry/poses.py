"""Rigid transforms as 4x4 matrices named `target_from_source`, so that products read off.

World: ENU, right-handed, z up, metres. Body: x forward, y left, z up. Yaw counter-clockwise from east, radians.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def pose(x: float, y: float, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """Return the (4, 4) transform of a body at x, y, z [m], rotated by yaw, then pitch, then roll [rad].

    Intrinsic z-y-x rotation; a positive pitch turns the nose down (right-hand rule about the left axis).
    """
    cy, sy, cp, sp, cr, sr = (
        np.cos(yaw),
        np.sin(yaw),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(roll),
        np.sin(roll),
    )
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def inverse(target_from_source: Array) -> Array:
    """Return `source_from_target` of a rigid (4, 4) transform."""
    rotation = target_from_source[:3, :3].T
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = -rotation @ target_from_source[:3, 3]
    return out


def is_rigid(target_from_source: Array) -> bool:
    """Return whether a (4, 4) matrix is a rotation and a shift, to 1e-6."""
    rotation = target_from_source[:3, :3]
    return bool(
        np.isfinite(target_from_source).all()
        and np.abs(rotation).max() < 2  # before numbers are multiplied that overflow
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        and np.linalg.det(rotation) > 0
        and np.array_equal(target_from_source[3], (0, 0, 0, 1))
    )


def yaw_of(target_from_source: Array) -> float:
    """Return the heading [rad] of the source's x axis in the target's x-y plane."""
    return float(np.arctan2(target_from_source[1, 0], target_from_source[0, 0]))


def transform_points(target_from_source: Array, points: ArrayLike) -> NDArray:
    """Return (N, 3) points moved from source to target, in the dtype they came in."""
    points = np.asarray(points)
    moved = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    return moved.astype(points.dtype, copy=False)


def wrap_angle(angle: ArrayLike) -> Array:
    """Return angles [rad] wrapped to [-pi, pi)."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi
