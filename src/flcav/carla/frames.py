"""Conversion between the world frame of a town and CARLA's left-handed frame.

CARLA's x is that of the map, its y is mirrored, its yaw is clockwise seen from above, and a positive pitch turns the
nose up (Unreal Engine). The town may be translated from the map by an offset. CARLA's angular velocities are in degrees
per second.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Array, angles_of, pose

Vector = tuple[float, float, float]

MIRROR = np.array((1.0, -1.0, 1.0))


def to_vector(values: Array) -> Vector:
    """Convert an array (3,) to a tuple."""
    x, y, z = values.tolist()
    return x, y, z


def mirror(vectors: NDArray[np.floating]) -> Array:
    """Convert vectors (..., 3), directions or points, between a right-handed frame and its mirror image in y."""
    return np.asarray(vectors, np.float64) * MIRROR


def mirror_spin(rates: Array) -> Array:
    """Convert angular velocities (..., 3) [rad/s], axial vectors, between a frame and its mirror image in y."""
    return -rates * MIRROR  # an axial vector changes its sign under reflection, unlike a polar one


def to_rotation(angles: Array) -> Array:
    """Convert yaw, pitch, roll (..., 3) [rad] of `geometry.pose` to CARLA's pitch, yaw, roll (..., 3) [deg].

    Yaws are within -180 and 180.
    """
    yaw, pitch, roll = np.moveaxis(np.degrees(angles), -1, 0)
    return np.stack((0.0 - pitch, (180.0 - yaw) % 360.0 - 180.0, roll), axis=-1)


@dataclass(frozen=True)
class MapFrame:
    """The frame of CARLA's map relative to the world frame of its town: town = map + offset."""

    offset_m: tuple[float, float] = (0.0, 0.0)  # x, y of the translation [m]

    def to_location(self, points: Array) -> Array:
        """Convert points (..., 3) [m] of the world frame to CARLA's locations (..., 3) [m]."""
        return mirror(points - (*self.offset_m, 0.0))

    def from_location(self, location: Vector) -> Array:
        """Convert CARLA's location [m] to a point (3,) [m] of the world frame."""
        return np.array((location[0] + self.offset_m[0], self.offset_m[1] - location[1], location[2]))

    def to_transform(self, world_from_body: Array) -> tuple[Vector, Vector]:
        """Convert a pose (4, 4) [m] of the world frame to CARLA's location [m] and rotation [deg]."""
        rotation = to_rotation(np.stack(angles_of(world_from_body[:3, :3])))
        return to_vector(self.to_location(world_from_body[:3, 3])), to_vector(rotation)

    def from_transform(self, location: Vector, rotation: Vector) -> Array:
        """Convert CARLA's location [m] and rotation [deg] to a pose (4, 4) [m] of the world frame."""
        return _pose(self.from_location(location), rotation)


def from_mount(location: Vector, rotation: Vector) -> Array:
    """Convert the relative location [m] and rotation [deg] of an attached actor to its (4, 4) pose, parent frame."""
    return _pose(mirror(np.array(location)), rotation)


def _pose(point: Array, rotation: Vector) -> Array:
    pitch, yaw, roll = np.radians(rotation)
    x, y, z = point.tolist()
    return pose(x, y, z, -yaw, -pitch, roll)
