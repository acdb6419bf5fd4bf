"""Rigs: the sensors of an agent with their mounts and settings, presets of rigs, and their calibration.

The true calibration (extrinsics, intrinsics, distortion, trigger times) follows from the rig. The agent assumes
another one, which differs by one Gaussian error per sensor and dataset.
"""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from flcav.arrays import Array
from flcav.config import Config
from flcav.geometry import heading_vectors, pose
from flcav.sensors.camera import Camera
from flcav.sensors.frame import LONGEST_NAME, Calibration
from flcav.sensors.infrared import Infrared
from flcav.sensors.lens import BODY_FROM_OPTICAL, Lens
from flcav.sensors.lidar.lidar import Lidar
from flcav.sensors.navigation import Gnss, Imu
from flcav.sensors.radar import Radar
from flcav.statistics.streams import stream

CAMERA_RANGE_M = (
    100.0  # range of ground truth for rigs without LiDAR; actors visible in an image are labelled at any distance
)
TRIGGER_MS = 100.0  # largest offset of a trigger from the spin
RESERVED = ("traces", "navigation", "town")  # folders of a dataset, which cannot be names of sensors
_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9_-]{{0,{LONGEST_NAME - 1}}}")

Reach = Annotated[float, Field(ge=-100, le=100)]  # [m]
Turn = Annotated[float, Field(ge=-360, le=360)]  # [deg]
# Velodyne's data sheet: range 50 m for pavement (reflectivity 0.1), 120 m for cars and foliage (0.8): 134 m for white.
# Its intensities are compressed, and many returns from dark or glossy bodies have intensity 0.
HDL64E = Lidar(beams="hdl64e", sensitivity_m=134.0, roughness_rad=0.6, intensity_gamma=0.5, intensity_floor=0.15)


class Mount(Config):
    """A sensor's pose in its agent's frame: x forward, y left, z up.

    A camera looks along x. A positive pitch is downwards.
    """

    x: Reach = 0.0  # position, forward [m]
    y: Reach = 0.0  # position, to the left [m]
    z: Reach = 0.0  # position, up [m]
    yaw_deg: Turn = 0.0  # yaw; positive turns to the left
    pitch_deg: Turn = 0.0  # pitch; positive tilts downwards
    roll_deg: Turn = 0.0  # roll; positive leans to the right

    def agent_from_sensor(self) -> Array:
        """Return the (4, 4) mount [m]; a camera's has body axes (x forward, y left, z up), not optical ones."""
        yaw, pitch, roll = np.radians((self.yaw_deg, self.pitch_deg, self.roll_deg))
        return pose(self.x, self.y, self.z, yaw, pitch, roll)


class Mounted(Config):
    """A sensor's mount and trigger time: base of all mounted sensors but LiDARs."""

    mount: Mount = Mount()  # pose on the agent
    trigger_ms: float = Field(default=0.0, ge=-TRIGGER_MS, le=TRIGGER_MS)  # trigger time after the spin


class MountedLidar(Config):
    """A LiDAR and its mount. Its spin defines the time of the frame, so it has no trigger time."""

    mount: Mount = Mount()  # pose on the agent
    settings: Lidar = Lidar()  # settings of the LiDAR


class MountedCamera(Mounted):
    """A colour camera, its mount and trigger time."""

    settings: Camera = Camera()  # settings of the camera


class MountedInfrared(Mounted):
    """A thermal camera, its mount and trigger time."""

    settings: Infrared = Infrared()  # settings of the thermal camera


class MountedRadar(Mounted):
    """A radar, its mount and trigger time."""

    settings: Radar = Radar()  # settings of the radar


class MountedGnss(Mounted):
    """A GNSS receiver, its antenna's mount and trigger time."""

    settings: Gnss = Gnss()  # error model of the receiver


class MountedImu(Mounted):
    """An inertial measurement unit (IMU), its mount and trigger time."""

    settings: Imu = Imu()  # error model of the unit


class Rig(Config):
    """The sensors of one agent, by kind and name. A car's frame is at its ground centre, a pole's at its mount.

    Names differ over all kinds; at least one LiDAR or camera is needed.
    """

    lidars: dict[str, MountedLidar] = Field(default_factory=dict)  # spinning LiDARs
    cameras: dict[str, MountedCamera] = Field(
        default_factory=dict
    )  # colour cameras, with depth, semantic class and instance of each pixel
    infrareds: dict[str, MountedInfrared] = Field(default_factory=dict)  # thermal cameras
    radars: dict[str, MountedRadar] = Field(default_factory=dict)  # 77 GHz radars
    gnss: dict[str, MountedGnss] = Field(default_factory=dict)  # satellite navigation receivers
    imus: dict[str, MountedImu] = Field(default_factory=dict)  # accelerometers and gyroscopes

    @model_validator(mode="after")
    def _check_names(self) -> "Rig":
        kinds = [getattr(self, kind) for kind in type(self).model_fields]
        if not (self.lidars or self.cameras or self.infrareds):
            raise ValueError("a rig needs at least one LiDAR or camera")
        times = Counter(name for kind in kinds for name in kind)
        for name, count in times.items():
            if count > 1:
                raise ValueError(f"two sensors are called '{name}'; names must differ over all kinds")
            if not _NAME.fullmatch(name) or name in RESERVED:
                raise ValueError(
                    f"sensor name '{name}': must be letters, digits, - and _, {LONGEST_NAME} at most, and none of "
                    f"{', '.join(RESERVED)}"
                )
        return self

    def sensors(self) -> Mapping[str, MountedLidar | Mounted]:
        """Return all sensors of all kinds, by name."""
        return {name: sensor for kind in type(self).model_fields for name, sensor in getattr(self, kind).items()}

    def with_navigation(self) -> "Rig":
        """Return the rig, with the GNSS receiver and the IMU of `car` if it has none."""
        known = car()
        return self.model_copy(update={"gnss": self.gnss or known.gnss, "imus": self.imus or known.imus})


def lidar32() -> Rig:
    """Return a rig with one 32-channel LiDAR above a car's roof."""
    return Rig(lidars={"lidar": MountedLidar(mount=Mount(z=1.85), settings=Lidar(channels=32, azimuth_steps=900))})


def lidar_pole() -> Rig:
    """Return a rig with one 64-channel LiDAR at a pole's mount, with channels from 2 degrees up to 45 degrees down."""
    settings = Lidar(channels=64, azimuth_steps=1024, range_m=100.0, up_deg=2.0, down_deg=-45.0, sensitivity_m=400.0)
    return Rig(lidars={"lidar": MountedLidar(settings=settings)})


def car(cameras: Mapping[str, MountedCamera] | None = None) -> Rig:
    """Return a car's rig: 32-channel LiDAR, front camera (or the given `cameras`), front radar, GNSS and IMU."""
    ahead = {"camera": MountedCamera(mount=Mount(x=0.5, z=1.5))}
    return Rig(
        lidars=lidar32().lidars,
        cameras=dict(ahead if cameras is None else cameras),
        radars={"radar": MountedRadar(mount=Mount(x=2.3, z=0.5))},
        gnss={"gnss": MountedGnss(mount=Mount(x=-0.5, z=1.6))},
        imus={"imu": MountedImu(mount=Mount(z=0.5))},
    )


def car_surround() -> Rig:
    """Return a car's rig with six surround cameras; directions and fields of view are those of nuScenes."""
    directions = {"front": 0, "front_left": 55, "front_right": -55, "back_left": 110, "back_right": -110, "back": 180}
    cameras = {}
    for name, yaw_deg in directions.items():
        x, y = heading_vectors(np.radians(yaw_deg))
        mount = Mount(x=round(float(x), 3), y=round(0.5 * float(y), 3), z=1.5, yaw_deg=yaw_deg)
        cameras[name] = MountedCamera(mount=mount, settings=Camera(fov_deg=110.0 if name == "back" else 70.0))
    return car(cameras)


def roadside() -> Rig:
    """Return a pole's rig: 64-channel LiDAR, and two cameras 42 degrees left and right of the pole's heading."""
    cameras = {
        name: MountedCamera(mount=Mount(yaw_deg=yaw_deg, pitch_deg=20.0))
        for name, yaw_deg in (("camera_left", 42.0), ("camera_right", -42.0))
    }
    return Rig(lidars=lidar_pole().lidars, cameras=cameras)


def kitti_lidar() -> Rig:
    """Return a rig with only KITTI's LiDAR (HDL-64E)."""
    return Rig(lidars={"velodyne": MountedLidar(mount=Mount(z=1.73), settings=HDL64E)})


def kitti() -> Rig:
    """Return KITTI's rig: HDL-64E, left colour camera, GNSS and IMU (Geiger et al., IJRR 32(11), 2013, fig. 3).

    Intrinsics and positions are those of the recordings of 26 September 2011; rotations of less than a degree are left
    out.
    """
    camera = Camera(width=1242, height=375, fx=721.5377, fy=721.5377, cx=609.5593, cy=172.854)
    unit = Mount(x=-0.81, y=0.32, z=0.93)
    return Rig(
        lidars=kitti_lidar().lidars,
        cameras={"image_2": MountedCamera(mount=Mount(x=0.27, y=0.06, z=1.65), settings=camera)},
        gnss={"gnss": MountedGnss(mount=unit)},
        imus={"imu": MountedImu(mount=unit)},
    )


RIGS: dict[str, Rig] = {
    "car": car(),
    "car_surround": car_surround(),
    "roadside": roadside(),
    "kitti": kitti(),
    "kitti_lidar": kitti_lidar(),
    "lidar32": lidar32(),
    "lidar_pole": lidar_pole(),
}


class CalibrationError(Config):
    """Standard deviations of the errors of calibration; a sensor's error is drawn once per dataset."""

    position_m: float = Field(default=0.0, ge=0, le=10)  # error of the mount's position along each axis of the sensor
    rotation_deg: float = Field(default=0.0, ge=0, le=45)  # error of the mount's rotation about each axis of the sensor
    focal_px: float = Field(default=0.0, ge=0, le=1000)  # error of the focal length, the same for both axes
    time_ms: float = Field(default=0.0, ge=0, le=1000)  # error of the trigger time


def build_calibration(rig: Rig) -> Calibration:
    """Return the true calibration of `rig`, by sensor name.

    For all sensors: the extrinsics (4, 4) [m], with optical axes for cameras, and the trigger time [ms] after the LiDAR
    spin; for colour and thermal cameras also the intrinsic matrix (3, 3) [px] and the distortion coefficients (5,).
    """
    lenses = _lenses(rig)
    return Calibration(
        agent_from_sensor={
            name: sensor.mount.agent_from_sensor() @ (BODY_FROM_OPTICAL if name in lenses else np.eye(4))
            for name, sensor in rig.sensors().items()
        },
        intrinsics={name: lens.intrinsics() for name, lens in lenses.items()},
        distortion={name: lens.distortion() for name, lens in lenses.items()},
        offset_ms={
            name: sensor.trigger_ms if isinstance(sensor, Mounted) else 0.0 for name, sensor in rig.sensors().items()
        },
    )


def perturb_calibration(true: Calibration, error: CalibrationError, *, seed: int, agent: str) -> Calibration:
    """Return the calibration that `agent` assumes: `true` with Gaussian errors, or `true` itself if `error` is zero.

    A sensor gets a rigid error of its extrinsics (translation and rotation vector, sensor frame), one of both focal
    lengths and one of its trigger time. They depend only on the seed and the names of the agent and the sensor.
    """
    if error == CalibrationError():
        return true
    drawn = {name: _draw(error, seed, agent, name) for name in true.agent_from_sensor}
    return replace(
        true,
        agent_from_sensor={name: mount @ drawn[name][0] for name, mount in true.agent_from_sensor.items()},
        intrinsics={name: matrix + drawn[name][1] * np.diag((1, 1, 0)) for name, matrix in true.intrinsics.items()},
        offset_ms={name: offset + drawn[name][2] for name, offset in true.offset_ms.items()},
    )


def _draw(error: CalibrationError, seed: int, agent: str, name: str) -> tuple[Array, float, float]:
    """Draw a sensor's errors: (4, 4) `sensor_from_assumed` of the extrinsics, focal length [px], trigger time [ms]."""
    normal = stream(seed, "calibration", agent, name).normal(size=8)
    sensor_from_assumed = np.eye(4)
    sensor_from_assumed[:3, :3] = Rotation.from_rotvec(error.rotation_deg * normal[3:6], degrees=True).as_matrix()
    sensor_from_assumed[:3, 3] = error.position_m * normal[:3]
    return sensor_from_assumed, error.focal_px * normal[6], error.time_ms * normal[7]


def _lenses(rig: Rig) -> Mapping[str, Lens]:
    return {name: camera.settings for name, camera in (*rig.cameras.items(), *rig.infrareds.items())}
