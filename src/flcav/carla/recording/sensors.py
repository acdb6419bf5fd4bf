"""Rigs as CARLA's sensors, and their data converted to flcav's units and frames.

A LiDAR turns once per tick, so that a measurement is a whole spin at one instant: with a lower rotation frequency a
tick would give a part of a spin. A LiDAR is accompanied by a semantic LiDAR with the same rays and no losses, a camera
by a depth camera and a semantic camera: the annotations come from these. Source: CARLA's documentation, "Sensors
reference".
"""

import queue
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from flcav.carla.frames import MapFrame, mirror, mirror_spin
from flcav.carla.recording.session import Session
from flcav.carla.recording.traffic import make_transform
from flcav.geometry import Array
from flcav.sensors.lens import Lens
from flcav.sensors.lidar.lidar import Lidar
from flcav.sensors.rig import Rig
from flcav.sources.recipe import STEP_S

if TYPE_CHECKING:
    import carla

SEMANTIC_POINT = np.dtype([("xyz", "<f4", 3), ("cosine", "<f4"), ("actor", "<u4"), ("tag", "<u4")])
FAR_M = 1000.0  # depth that is coded by 24 bits of ones
DEPTH_STEPS = 2**24 - 1
SKY_M = 0.999 * FAR_M  # greater depths are sky
PINHOLE = {  # a camera without the lens effects that CARLA simulates by default
    **{"lens_k": "0.0", "lens_kcube": "0.0", "lens_circle_multiplier": "0.0", "chromatic_aberration_intensity": "0.0"},
    **{"lens_flare_intensity": "0.0", "motion_blur_intensity": "0.0"},
}


class SemanticSweep(NamedTuple):
    """The N returns of a semantic LiDAR."""

    points: NDArray[np.float32]  # (N, 3) sensor frame [m]
    actor: NDArray[np.uint32]  # (N,) CARLA's actor id; 0 for the town
    tag: NDArray[np.uint32]  # (N,) semantic class


@dataclass
class Feed:
    """The data of one of CARLA's sensors at selected ticks."""

    name: str
    actor: "carla.Sensor"

    def __post_init__(self) -> None:
        self._data: queue.SimpleQueue[carla.SensorData] = queue.SimpleQueue()
        self._from: int | None = None
        self.actor.listen(self._receive)

    def _receive(self, data: "carla.SensorData") -> None:
        if self._from is not None and data.frame >= self._from:
            self._data.put(data)

    def expect(self, frame: int) -> None:
        """Keep the data from the coming tick `frame` on."""
        self._from = frame

    def take(self, frame: int, timeout_s: float) -> "carla.SensorData":
        """Return the data of the tick `frame`. Raises `OSError` where it is late or missing."""
        while True:
            try:
                data = self._data.get(timeout=timeout_s)
            except queue.Empty:
                raise OSError(
                    f"CARLA's sensor '{self.name}' delivered nothing of tick {frame} within {timeout_s:g} s; the same "
                    "command goes on with this scene"
                ) from None
            if data.frame == frame:
                self._from = None
                return data
            if data.frame > frame:
                raise OSError(f"CARLA's sensor '{self.name}' left out tick {frame}; the same command goes on")


def spawn_feeds(
    session: Session, rig: Rig, agent: str, base: Array, parent: "carla.Actor | None", frame: MapFrame, seed: int
) -> dict[str, Feed]:
    """Spawn the CARLA sensors of a rig and the auxiliary ones; return their feeds by name.

    Auxiliary sensors are named by `semantic_name` and `depth_name`. `base` is the (4, 4) pose of the agent [m]: in the
    frame of the actor `parent`, or, without it, in the world frame.
    """
    specifications: dict[str, tuple[str, Mapping[str, str], Array]] = {}
    for name, lidar in rig.lidars.items():
        mount, attributes = lidar.mount.agent_from_sensor(), _lidar_attributes(lidar.settings)
        losses = _loss_attributes(lidar.settings, seed)
        specifications[name] = "sensor.lidar.ray_cast", attributes | losses, mount
        specifications[semantic_name(name)] = "sensor.lidar.ray_cast_semantic", attributes, mount
    for name, camera in rig.cameras.items():
        mount, attributes = camera.mount.agent_from_sensor(), _camera_attributes(camera.settings)
        specifications[name] = "sensor.camera.rgb", attributes | PINHOLE, mount
        specifications[depth_name(name)] = "sensor.camera.depth", attributes, mount
        specifications[semantic_name(name)] = "sensor.camera.semantic_segmentation", attributes, mount
    for kind, sensors in (("gnss", rig.gnss), ("imu", rig.imus)):
        specifications |= {
            name: (f"sensor.other.{kind}", {}, sensor.mount.agent_from_sensor()) for name, sensor in sensors.items()
        }
    library, feeds = session.world.get_blueprint_library(), dict[str, Feed]()
    for name, (kind, attributes, mount) in specifications.items():
        blueprint = library.find(kind)
        for attribute, value in attributes.items():
            if blueprint.has_attribute(attribute):
                blueprint.set_attribute(attribute, value)
        place = make_transform(base @ mount, MapFrame() if parent is not None else frame)
        sensor = cast("carla.Sensor", session.world.spawn_actor(blueprint, place, attach_to=parent))
        feeds[name] = Feed(f"{name}' of '{agent}", sensor)
    return feeds


def semantic_name(name: str) -> str:
    """Return the name of the semantic feed of the LiDAR or camera `name`; no sensor of a rig has such a name."""
    return f"{name}.classes"


def depth_name(name: str) -> str:
    """Return the name of the depth feed of the camera `name`."""
    return f"{name}.depths"


def read_lidar_points(data: "carla.LidarMeasurement") -> NDArray[np.float32]:
    """Return the points (N, 4) of a sweep: x, y, z [m], sensor frame, and intensity."""
    points = np.frombuffer(bytes(data.raw_data), "<f4").reshape(-1, 4) * np.array((1, -1, 1, 1), np.float32)
    return np.clip(points, (-np.inf, -np.inf, -np.inf, 0), (np.inf, np.inf, np.inf, 1)).astype(np.float32)


def read_semantic_points(data: "carla.SemanticLidarMeasurement") -> SemanticSweep:
    """Return the returns of a semantic LiDAR, sensor frame."""
    points = np.frombuffer(bytes(data.raw_data), SEMANTIC_POINT)
    return SemanticSweep(mirror(points["xyz"]).astype(np.float32), points["actor"], points["tag"])


def read_colours(image: "carla.Image") -> NDArray[np.uint8]:
    """Return an image as RGB (H, W, 3)."""
    return np.ascontiguousarray(_pixels(image)[..., 2::-1])


def read_depths(image: "carla.Image") -> NDArray[np.float32]:
    """Return the depths (H, W) along the optical axis [m], inf for the sky."""
    blue, green, red = (_pixels(image)[..., channel].astype(np.float64) for channel in range(3))
    depth = (red + 256 * green + 65536 * blue) * (FAR_M / DEPTH_STEPS)
    return np.where(depth < SKY_M, np.maximum(depth, 1e-3), np.inf).astype(np.float32)


def read_classes(image: "carla.Image") -> NDArray[np.uint8]:
    """Return the semantic classes (H, W) of an image."""
    return np.ascontiguousarray(_pixels(image)[..., 2])


def read_fix(data: "carla.GnssMeasurement") -> Array:
    """Return a GNSS fix (3,): latitude, longitude [deg], altitude [m]."""
    return np.array((data.latitude, data.longitude, data.altitude))


def read_inertia(data: "carla.IMUMeasurement") -> Array:
    """Return an IMU measurement (6,): specific force [m/s^2] and angular rate [rad/s], IMU frame."""
    force, rate = (np.array((vector.x, vector.y, vector.z)) for vector in (data.accelerometer, data.gyroscope))
    return np.concatenate((mirror(force), mirror_spin(rate)))


def _pixels(image: "carla.Image") -> NDArray[np.uint8]:
    """Return blue, green, red, alpha (H, W, 4)."""
    return np.frombuffer(bytes(image.raw_data), np.uint8).reshape(image.height, image.width, 4)


def _lidar_attributes(lidar: Lidar) -> dict[str, str]:
    turns_hz = 1 / STEP_S
    return {
        "channels": str(lidar.channels),
        "range": str(lidar.range_m),
        "points_per_second": str(round(lidar.channels * lidar.azimuth_steps * turns_hz)),
        "rotation_frequency": str(turns_hz),
        "upper_fov": str(lidar.up_deg),
        "lower_fov": str(lidar.down_deg),
        "horizontal_fov": "360.0",
    }


def _loss_attributes(lidar: Lidar, seed: int) -> dict[str, str]:
    """Return the attributes of noise and losses: those of `carla`, or `dropout`, independent of distance."""
    if lidar.carla is not None:
        losses = {name: str(value) for name, value in lidar.carla.model_dump().items()}
    else:
        losses = {"dropoff_general_rate": str(lidar.dropout), "dropoff_zero_intensity": "0.0"}
    return losses | {"noise_stddev": str(lidar.noise_m), "noise_seed": str(seed)}


def _camera_attributes(lens: Lens) -> dict[str, str]:
    fov = np.degrees(2 * np.arctan(lens.width / 2 / lens.intrinsics()[0, 0]))
    return {"image_size_x": str(lens.width), "image_size_y": str(lens.height), "fov": str(float(fov))}
