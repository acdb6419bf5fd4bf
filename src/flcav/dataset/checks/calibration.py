"""What can be wrong with a dataset's calibrations: each check returns sentences, none where all is well."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flcav.dataset.calibration import Calibrations
from flcav.geometry import inverse, is_rigid
from flcav.sensors.calibration import CalibrationError
from flcav.sensors.frame import Calibration

SIGMAS = 6.0  # a drawn error is never so many standard deviations off
EXACT = 1e-6  # [m], [rad], [px], [ms]


def check_calibrations(calibrations: Mapping[str, Calibrations], recipe: Mapping[str, Any]) -> Iterator[str]:
    """Check that mounts are rigid and lenses possible, and that beliefs are as wrong as the recipe says."""
    error = CalibrationError.model_validate(recipe.get("calibration_error") or {})
    for agent, (true, assumed) in calibrations.items():
        for which, calibration in (("true", true), ("assumed", assumed)):
            yield from check_calibration(f"the {which} calibration of {agent}", calibration)
        yield from check_belief(agent, true, assumed, error)


def check_calibration(name: str, calibration: Calibration) -> Iterator[str]:
    """Check one calibration."""
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


def check_belief(agent: str, true: Calibration, assumed: Calibration, error: CalibrationError) -> Iterator[str]:
    """Check that what `agent` believes differs from the truth by no more than errors of that size."""
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
