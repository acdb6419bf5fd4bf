"""Checks of calibrations: rigid mounts, valid intrinsics, plausible calibration errors.

Each check yields one sentence per problem.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from flcav.dataset.calibration import Calibrations
from flcav.geometry import inverse, is_rigid
from flcav.sensors.frame import Calibration
from flcav.sensors.rig import CalibrationError

SIGMAS = 6.0  # a larger error, in standard deviations, is reported
EXACT = 1e-6  # tolerance of rounding, in the unit of each error: [m], [degrees], [px], [ms]


def check_calibrations(calibrations: Mapping[str, Calibrations], error: CalibrationError) -> Iterator[str]:
    """Check true and assumed calibrations by agent, and their difference against `error` of the recipe."""
    for agent, (true, assumed) in calibrations.items():
        for which, calibration in (("true", true), ("assumed", assumed)):
            yield from check_calibration(f"the {which} calibration of {agent}", calibration)
        yield from check_assumed(agent, true, assumed, error)


def check_calibration(name: str, calibration: Calibration) -> Iterator[str]:
    """Check one calibration: rigid mounts, pinhole intrinsics without skew, finite distortion and trigger times.

    `name` names it in the sentences.
    """
    for sensor, mount in calibration.agent_from_sensor.items():
        if not is_rigid(mount):
            yield f"{name}: the mount of '{sensor}' is not a rigid transform"
    for sensor, matrix in calibration.intrinsics.items():
        focal, skew = matrix[[0, 1], [0, 1]], matrix[[0, 1, 2, 2], [1, 0, 0, 1]]
        if not np.isfinite(matrix).all() or (focal <= 0).any() or skew.any() or matrix[2, 2] != 1:
            yield f"{name}: the intrinsics of '{sensor}' are not those of a camera"
    for sensor, coefficients in calibration.distortion.items():
        if not np.isfinite(coefficients).all():
            yield f"{name}: the distortion of '{sensor}' is not finite"
    for sensor, offset_ms in calibration.offset_ms.items():
        if not np.isfinite(offset_ms):
            yield f"{name}: the trigger time of '{sensor}' is not finite"


def check_assumed(agent: str, true: Calibration, assumed: Calibration, error: CalibrationError) -> Iterator[str]:
    """Check that the assumed calibration of `agent` differs from the true one by at most SIGMAS standard deviations.

    `error` gives the standard deviations.
    """
    for sensor in sorted(true.agent_from_sensor.keys() & assumed.agent_from_sensor.keys()):
        if not (is_rigid(true.agent_from_sensor[sensor]) and is_rigid(assumed.agent_from_sensor[sensor])):
            continue
        between = inverse(true.agent_from_sensor[sensor]) @ assumed.agent_from_sensor[sensor]
        turned_deg = np.degrees(np.abs(Rotation.from_matrix(between[:3, :3]).as_rotvec()).max())
        focal_px = 0.0
        if sensor in true.intrinsics and sensor in assumed.intrinsics:
            focal_px = float(np.abs(assumed.intrinsics[sensor] - true.intrinsics[sensor]).max())
        off = {
            "position_m": float(np.abs(between[:3, 3]).max()),
            "rotation_deg": float(turned_deg),
            "focal_px": focal_px,
            "time_ms": abs(assumed.offset_ms.get(sensor, 0.0) - true.offset_ms.get(sensor, 0.0)),
        }
        for name, value in off.items():
            allowed = SIGMAS * getattr(error, name) + EXACT
            if value > allowed:
                yield f"{agent} believes '{sensor}' off by {name} = {value:.4g}, its recipe allows {allowed:.4g}"
