"""The sensors that are served, and when each is due."""

from collections.abc import Callable
from typing import NamedTuple

from flcav.carla.server.sensing import cameras, motion, rays
from flcav.carla.server.sensing.sight import Sensor, Sight
from flcav.carla.server.wire import Stream


class Kind(NamedTuple):
    """How a kind of sensor measures."""

    stream: Stream
    measure: Callable[[Sight, Sensor], bytes] | None  # None: it sends what happens, not what it sees
    rays: bool = False  # it casts rays, which takes its time
    late: bool = False  # it draws an image, which takes longer


KINDS: dict[str, Kind] = {
    "sensor.camera.rgb": Kind(Stream.RGB, cameras.sense_rgb, True, True),
    "sensor.camera.depth": Kind(Stream.DEPTH, cameras.sense_depth, True, True),
    "sensor.camera.semantic_segmentation": Kind(Stream.SEMANTIC, cameras.sense_semantic, True, True),
    "sensor.camera.instance_segmentation": Kind(Stream.INSTANCE, cameras.sense_instance, True, True),
    "sensor.lidar.ray_cast": Kind(Stream.LIDAR, rays.sense_lidar, True),
    "sensor.lidar.ray_cast_semantic": Kind(Stream.SEMANTIC_LIDAR, rays.sense_semantic_lidar, True),
    "sensor.other.gnss": Kind(Stream.GNSS, motion.sense_gnss),
    "sensor.other.imu": Kind(Stream.IMU, motion.sense_imu),
    "sensor.other.radar": Kind(Stream.RADAR, rays.sense_radar, True),
    "sensor.other.collision": Kind(Stream.COLLISION, None),
    "sensor.other.lane_invasion": Kind(Stream.LANE_INVASION, None),  # clients find these themselves, from the map
    "sensor.other.obstacle": Kind(Stream.OBSTACLE, None),
}
EARLY_S = 1e-6  # rounding of times


class Clock:
    """When a sensor measures: at its first tick, and then every `sensor_tick`, or every tick where that is 0."""

    def __init__(self, tick_s: float) -> None:
        """Take the sensor's `sensor_tick` [s]."""
        self._tick_s = tick_s
        self._next_s: float | None = None
        self._last_s: float | None = None

    def take(self, time_s: float, dt_s: float) -> float | None:
        """Return the time since the last measurement [s] where one is due at `time_s`, `dt_s` after the last tick.

        The first one stands for a whole `sensor_tick`. None where none is due.
        """
        if self._next_s is not None and time_s < self._next_s - EARLY_S:
            return None
        elapsed = max(self._tick_s, dt_s) if self._last_s is None else round(time_s - self._last_s, 9)
        due = time_s if self._next_s is None else self._next_s
        self._next_s = max(due + self._tick_s, time_s) if self._tick_s else time_s
        self._last_s = time_s
        return elapsed
