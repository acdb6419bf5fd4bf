"""Rolling LiDAR spins: motion of the sensor and of the traffic during a spin, and its compensation.

The beams point straight ahead at the scene's instant and turn counter-clockwise: a spin begins half its duration before
the instant and ends half its duration after it. Azimuth is divided into SECTORS, which are cast with the world at the
time when the beams pass the middle of the sector. Points are not motion-compensated: a point is in the sensor frame at
the time of its measurement.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array, Array32, Ints
from flcav.geometry import heading_vectors, inverse
from flcav.world.scene import Scene
from flcav.world.trace import Trace

SECTORS = 36
ROUNDING = 1e-6  # turns: a beam straight back belongs to the beginning of the spin, not to its end


def step_sectors(
    scene: Scene, world_from_sensor: Array, steps: int, spin_s: float, carrier: int | None
) -> Iterator[tuple[Ints, Array]]:
    """Yield the sectors' columns (C,) of the ray pattern and the (4, 4) poses of the sensor at the sectors' times.

    `scene` is at a sector's time while the sector is in use, and is moved back at the end. `world_from_sensor` (4, 4)
    [m] is the pose at the scene's instant, `steps` the columns of a spin of `spin_s` [s], `carrier` the actor that
    carries the sensor (None: it is stationary).
    """
    index = scene.index
    instant_s = scene.offset_s

    def pose_now() -> Array:
        return world_from_sensor if carrier is None else scene.world_from_actor(carrier) @ carrier_from_sensor

    carrier_from_sensor = np.eye(4) if carrier is None else inverse(scene.world_from_actor(carrier)) @ world_from_sensor
    sector = (
        np.arange(steps) * SECTORS // steps + SECTORS // 2
    ) % SECTORS  # per column, numbered in the order of casting
    try:
        for number in range(SECTORS):
            columns = np.flatnonzero(sector == number)
            scene.move_to(index, instant_s + ((number + 0.5) / SECTORS - 0.5) * spin_s)
            yield columns, pose_now()
    finally:
        scene.move_to(index, instant_s)


def time_in_spin_s(points: Array32, spin_s: float) -> Array32:
    """Return the times (N,) [s] of points (N, >=2), sensor frame, relative to the middle of the spin, by azimuth."""
    turned = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    return (((turned + ROUNDING) % 1.0 - 0.5) * spin_s).astype(np.float32)


class Motion(NamedTuple):
    """Planar rigid motion about an instant: constant acceleration and yaw rate, world frame, as in `Scene.move_to`."""

    origin: Array  # (3,) position at the instant [m]
    velocity: Array  # (3,) [m/s]
    acceleration: Array  # (3,) [m/s^2]
    yaw_rate: float  # [rad/s]

    @classmethod
    def of(cls, trace: Trace, index: int, actor: int) -> "Motion":
        """Return the motion of an actor (its row in `trace`) at instant `index`, when it must be present."""
        at = index, actor
        return cls(trace.position[at], trace.velocity[at], trace.acceleration[at], float(trace.yaw_rate[at]))

    def carry(self, points: Array, times_s: NDArray[np.floating]) -> Array:
        """Return the positions (N, 3) [m] of body-fixed points at `times_s` (N,) [s] after the instant, world frame.

        `points` (N, 3) [m] are their positions at the instant. Points of a rolling sweep, transformed to the world by
        the sensor's pose at the instant, are thereby moved to where they were measured.
        """
        return _turn(points - self.origin, self.yaw_rate * times_s) + self.origin + self._way(times_s)

    def bring_back(self, points: Array, times_s: NDArray[np.floating]) -> Array:
        """Return the positions (N, 3) [m] at the instant of points on the body measured `times_s` (N,) [s] after it."""
        return _turn(points - self.origin - self._way(times_s), -self.yaw_rate * times_s) + self.origin

    def _way(self, times_s: NDArray[np.floating]) -> Array:
        seconds = times_s.astype(np.float64)[:, None]
        return seconds * self.velocity + seconds**2 / 2 * self.acceleration


def _turn(points: Array, angles: NDArray[np.floating]) -> Array:
    x, y, z = points.T
    cos, sin = heading_vectors(angles).T
    return np.column_stack((cos * x - sin * y, sin * x + cos * y, z))
