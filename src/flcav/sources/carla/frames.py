"""CARLA's coordinates and ours, which are right-handed: y points to the other side.

CARLA has Unreal's left-handed frames: x ahead, y right, z up; a positive yaw turns right, a positive pitch lifts the
nose, a positive roll leans to the right.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import yaw_of

Array = NDArray[np.float64]

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def carla_pose(world_from_body: Array) -> list[float]:
    """Return [x, y, z [m], roll, yaw, pitch [degrees]] in CARLA's world of a (4, 4) `world_from_body`.

    The body's axes are x ahead, y left, z up.
    """
    matrix = MIRROR @ world_from_body @ MIRROR
    roll = np.arctan2(-matrix[2, 1], matrix[2, 2])
    pitch = np.arcsin(np.clip(matrix[2, 0], -1, 1))
    return [*matrix[:3, 3].tolist(), *np.degrees((roll, yaw_of(matrix), pitch)).tolist()]


def from_carla(values: Sequence[float]) -> Array:
    """Return the (4, 4) `world_from_body` of a pose x, y, z, roll, yaw, pitch: the inverse of `carla_pose`.

    OpenCOOD's `x_to_world`, mirrored.
    """
    x, y, z, *angles = values
    (cr, cy, cp), (sr, sy, sp) = np.cos(np.radians(angles)), np.sin(np.radians(angles))
    matrix = np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return MIRROR @ matrix @ MIRROR
