"""A spin takes time: the sensor turns, and meanwhile it and everybody else move on.

The beams look straight ahead at the scene's instant and turn counter-clockwise, so that a spin begins half its
duration before and ends half its duration after. Azimuth is cut into SECTORS, each traced with the world as it is when
the beams pass its middle. Points are left where the sensor measured them, each in the sensor's frame of its own time.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import inverse
from flcav.world.scene import Scene
from flcav.world.trace import Trace

Array = NDArray[np.float64]

SECTORS = 36
ROUNDING = 1e-6  # of a turn: what looks straight back belongs to the beginning of the spin, not to its end


def sectors(
    scene: Scene, world_from_sensor: NDArray[np.float64], steps: int, spin_s: float, carrier: int | None
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Yield each sector's columns (C,) of the pattern and the (4, 4) pose of the sensor at its time.

    While a sector is out, `scene` stands at its time; afterwards it stands where it was. `world_from_sensor` is the
    pose at the scene's instant, `steps` the columns of a spin of `spin_s`, `carrier` the actor that the sensor is on.
    """
    index, instant_s = scene.index, scene.offset_s

    def pose_now() -> NDArray[np.float64]:
        return world_from_sensor if carrier is None else scene.world_from_actor(carrier) @ carrier_from_sensor

    carrier_from_sensor = np.eye(4) if carrier is None else inverse(scene.world_from_actor(carrier)) @ world_from_sensor
    sector = (np.arange(steps) * SECTORS // steps + SECTORS // 2) % SECTORS  # in the order they are traced
    try:
        for number in range(SECTORS):
            columns = np.flatnonzero(sector == number)
            scene.move_to(index, instant_s + ((number + 0.5) / SECTORS - 0.5) * spin_s)
            yield columns, pose_now()
    finally:
        scene.move_to(index, instant_s)


def time_in_spin_s(points: NDArray[np.float32], spin_s: float) -> NDArray[np.float32]:
    """Return when each point (N, >=2) of a spin, in the sensor's frame, was measured: (N,) [s] after its middle."""
    turned = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    return (((turned + ROUNDING) % 1.0 - 0.5) * spin_s).astype(np.float32)


class Motion(NamedTuple):
    """How a body moves about an instant of the traffic, as in `Scene.move_to`: world frame, about the vertical."""

    origin: Array  # (3,) at the instant [m]
    velocity: Array  # (3,) [m/s]
    acceleration: Array  # (3,) [m/s^2]
    yaw_rate: float  # [rad/s]

    @classmethod
    def of(cls, trace: Trace, index: int, actor: int) -> "Motion":
        """Return the motion of a trace's actor, present at instant `index`."""
        at = index, actor
        return cls(trace.position[at], trace.velocity[at], trace.acceleration[at], float(trace.yaw_rate[at]))

    def carry(self, points: Array, times_s: NDArray[np.floating]) -> Array:
        """Return (N, 3) where points that the body carries are `times_s` (N,) after the instant.

        `points` are where they are at the instant, such as those of a sweep, put into the world by its pose then: so
        they come to lie where they were measured.
        """
        return _turn(points - self.origin, self.yaw_rate * times_s) + self.origin + self._way(times_s)

    def bring_back(self, points: Array, times_s: NDArray[np.floating]) -> Array:
        """Return (N, 3) where points on the body, seen at `times_s` (N,) after the instant, are at the instant."""
        return _turn(points - self.origin - self._way(times_s), -self.yaw_rate * times_s) + self.origin

    def _way(self, times_s: NDArray[np.floating]) -> Array:
        seconds = times_s.astype(np.float64)[:, None]
        return seconds * self.velocity + seconds**2 / 2 * self.acceleration


def _turn(points: Array, angles: NDArray[np.floating]) -> Array:
    x, y, z = points.T
    cos, sin = np.cos(angles), np.sin(angles)
    return np.column_stack((cos * x - sin * y, sin * x + cos * y, z))
