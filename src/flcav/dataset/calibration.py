"""The calibration file of a dataset: for each agent, how its sensors are, and how it believes them to be.

agent -> "true" | "assumed" -> sensor -> {"agent_from_sensor": 16 numbers row by row, "offset_ms", and of a camera
"intrinsics": 9 numbers row by row, "distortion": 5}.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flcav.config import InputError, read_json
from flcav.sensors.frame import Calibration, Frame

SHAPES = {"agent_from_sensor": (4, 4), "intrinsics": (3, 3), "distortion": (5,)}


class Calibrations(NamedTuple):
    """Of one agent."""

    true: Calibration
    assumed: Calibration


def to_json(frame: Frame) -> dict[str, Any]:
    """Return the calibration of the frame's agent as it is kept in the file."""
    return {"true": _sensors(frame.calibration), "assumed": _sensors(frame.assumed)}


def read_calibrations(path: Path, sensors: Mapping[str, set[str]]) -> dict[str, Calibrations]:
    """Return the calibrations by agent; raises `InputError` where one of its `sensors` is missing or malformed."""
    values: Any = read_json(path)
    found = {}
    for agent, names in sensors.items():
        try:
            both = Calibrations(*(_calibration(values[agent][which]) for which in ("true", "assumed")))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(f"{path}: the calibration of '{agent}' is missing or malformed ({error})") from None
        for name in sorted(names):
            if name not in both.true.agent_from_sensor or name not in both.assumed.agent_from_sensor:
                raise InputError(f"{path}: no mount of the sensor '{name}' of '{agent}'")
        found[agent] = both
    return found


def _sensors(calibration: Calibration) -> dict[str, Any]:
    return {
        sensor: {
            "offset_ms": float(calibration.offset_ms.get(sensor, 0.0)),
            **{
                field: np.asarray(getattr(calibration, field)[sensor]).ravel().tolist()
                for field in SHAPES
                if sensor in getattr(calibration, field)
            },
        }
        for sensor in calibration.agent_from_sensor
    }


def _calibration(sensors: dict[str, Any]) -> Calibration:
    def values(field: str) -> dict[str, np.ndarray]:
        return {
            name: np.array(sensor[field], np.float64).reshape(SHAPES[field])
            for name, sensor in sensors.items()
            if field in sensor
        }

    return Calibration(
        values("agent_from_sensor"),
        values("intrinsics"),
        values("distortion"),
        {name: float(sensor["offset_ms"]) for name, sensor in sensors.items()},
    )
