"""Calibration of a rig (extrinsics, intrinsics, distortion, trigger times), and random errors of calibration.

The true calibration follows from the rig. The agent works with an assumed one, which differs by one Gaussian error per
sensor and dataset.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from flcav.config import Config
from flcav.sensors.frame import Array, Calibration
from flcav.sensors.lens import BODY_FROM_OPTICAL, Lens
from flcav.sensors.rig import Mounted, Rig
from flcav.statistics.streams import stream


class CalibrationError(Config):
    """Standard deviations of the errors of calibration; a sensor's error is drawn once per dataset."""

    position_m: float = Field(default=0.0, ge=0, le=10)  # error of the mount's position along each axis of the sensor
    rotation_deg: float = Field(default=0.0, ge=0, le=45)  # error of the mount's rotation about each axis of the sensor
    focal_px: float = Field(default=0.0, ge=0, le=1000)  # error of the focal length, the same for both axes
    time_ms: float = Field(default=0.0, ge=0, le=1000)  # error of the trigger time


def build_calibration(rig: Rig) -> Calibration:
    """Return the true calibration of `rig`, by sensor name.

    Of all sensors: the mount (4, 4), with optical axes for cameras, and the trigger time [ms] after the LiDAR spin. Of
    colour and thermal cameras also: the intrinsic matrix (3, 3) [px] and the distortion coefficients (5,).
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
    """Return the calibration that `agent` assumes: `true` with Gaussian errors; `true` itself where `error` is zero.

    Each sensor gets a rigid error of its mount (translation, rotation vector; in the sensor's axes), one of both focal
    lengths and one of its trigger time. They depend on the seed and the names of the agent and the sensor alone.
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
    """Return one sensor's errors: (4, 4) `sensor_from_assumed` of the mount, focal length [px], trigger time [ms]."""
    normal = stream(seed, "calibration", agent, name).normal(size=8)
    sensor_from_assumed = np.eye(4)
    sensor_from_assumed[:3, :3] = Rotation.from_rotvec(error.rotation_deg * normal[3:6], degrees=True).as_matrix()
    sensor_from_assumed[:3, 3] = error.position_m * normal[:3]
    return sensor_from_assumed, error.focal_px * normal[6], error.time_ms * normal[7]


def _lenses(rig: Rig) -> Mapping[str, Lens]:
    return {name: camera.settings for name, camera in (*rig.cameras.items(), *rig.infrareds.items())}
