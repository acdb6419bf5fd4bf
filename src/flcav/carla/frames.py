"""Conversion between the town's frame and CARLA's: the only place that knows a left-handed frame.

CARLA's x is that of the map, its y is mirrored, its yaw turns clockwise seen from above, and a positive pitch is
upwards (Unreal Engine). The town may be moved from the map by an offset. Angular velocities are in degrees per second.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Array, angles_of, pose

Vector = tuple[float, float, float]

MIRROR = np.array((1.0, -1.0, 1.0))


def to_vector(values: Array) -> Vector:
    """Return three numbers (3,) as a tuple."""
    x, y, z = values.tolist()
    return x, y, z


def mirror(vectors: NDArray[np.floating]) -> Array:
    """Return vectors (..., 3), directions or points, of one frame in the other."""
    return np.asarray(vectors, np.float64) * MIRROR


def mirror_spin(rates: Array) -> Array:
    """Return angular velocities (..., 3) [rad/s], an axial vector, of one frame in the other."""
    return -rates * MIRROR


def to_rotation(angles: Array) -> Array:
    """Return CARLA's pitch, yaw and roll (..., 3) [deg] of yaw, pitch and roll (..., 3) [rad] as in `geometry.pose`.

    Yaws are within -180 and 180.
    """
    yaw, pitch, roll = np.moveaxis(np.degrees(angles), -1, 0)
    return np.stack((0.0 - pitch, (180.0 - yaw) % 360.0 - 180.0, roll), axis=-1)


@dataclass(frozen=True)
class MapFrame:
    """The frame of a map that clients see, beside that of its town: town = map + offset."""

    offset_m: tuple[float, float] = (0.0, 0.0)

    def to_location(self, points: Array) -> Array:
        """Return CARLA's locations (..., 3) of points (..., 3) of the town."""
        return mirror(points - (*self.offset_m, 0.0))

    def from_location(self, location: Vector) -> Array:
        """Return the point (3,) of the town at CARLA's location."""
        return np.array((location[0] + self.offset_m[0], self.offset_m[1] - location[1], location[2]))

    def to_transform(self, world_from_body: Array) -> tuple[Vector, Vector]:
        """Return CARLA's location and rotation of a pose (4, 4) in the town."""
        rotation = to_rotation(np.stack(angles_of(world_from_body[:3, :3])))
        return to_vector(self.to_location(world_from_body[:3, 3])), to_vector(rotation)

    def from_transform(self, location: Vector, rotation: Vector) -> Array:
        """Return the pose (4, 4) in the town of CARLA's location and rotation."""
        return _pose(self.from_location(location), rotation)


def from_mount(location: Vector, rotation: Vector) -> Array:
    """Return the pose (4, 4) of an attached actor in its parent's frame."""
    return _pose(mirror(np.array(location)), rotation)


def _pose(point: Array, rotation: Vector) -> Array:
    pitch, yaw, roll = np.radians(rotation)
    x, y, z = point.tolist()
    return pose(x, y, z, -yaw, -pitch, roll)
