"""The calibration file of a dataset: true and assumed extrinsics, intrinsics and trigger times of the sensors.

JSON: agent -> `AgentEntry`. See `flcav.sensors.frame`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, NotRequired, TypedDict

import numpy as np

from flcav.config import InputError, read_json
from flcav.sensors.frame import Calibration, Frame

SHAPES = {"agent_from_sensor": (4, 4), "intrinsics": (3, 3), "distortion": (5,)}


class Calibrations(NamedTuple):
    """The true calibration of an agent, and the calibration that the agent assumes."""

    true: Calibration
    assumed: Calibration


class SensorEntry(TypedDict):
    """The entry of a sensor in the calibration file."""

    agent_from_sensor: list[float]  # extrinsics: 4x4 transform from the sensor to the agent frame, row-major [m]
    offset_ms: float  # trigger time relative to the spin [ms]
    intrinsics: NotRequired[list[float]]  # of a camera: 3x3 matrix, row-major [px]
    distortion: NotRequired[list[float]]  # of a camera: k1, k2, p1, p2, k3


class AgentEntry(TypedDict):
    """The entry of an agent in the calibration file: its sensors' true calibration, and the one that it assumes."""

    true: dict[str, SensorEntry]
    assumed: dict[str, SensorEntry]


def encode_calibration(frame: Frame) -> AgentEntry:
    """Return the entry of the frame's agent in the calibration file."""
    return {"true": _sensors(frame.calibration), "assumed": _sensors(frame.assumed)}


def read_calibrations(path: Path, sensors: Mapping[str, set[str]]) -> dict[str, Calibrations]:
    """Return agent -> calibrations, read from the calibration file at `path`.

    `sensors` maps each agent to the names of its sensors. Raises `InputError` where the file is missing or not JSON, an
    agent's entry is missing or malformed, or a sensor has no mount.
    """
    values: Any = read_json(path)
    calibrations = {}
    for agent, names in sensors.items():
        try:
            both = Calibrations(*(_calibration(values[agent][which]) for which in ("true", "assumed")))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(f"{path}: the calibration of '{agent}' is missing or malformed ({error})") from None
        for name in sorted(names):
            if name not in both.true.agent_from_sensor or name not in both.assumed.agent_from_sensor:
                raise InputError(f"{path}: no mount of the sensor '{name}' of '{agent}'")
        calibrations[agent] = both
    return calibrations


def _sensors(calibration: Calibration) -> dict[str, SensorEntry]:
    entries: dict[str, SensorEntry] = {}
    for sensor, mount in calibration.agent_from_sensor.items():
        entry = entries[sensor] = {
            "offset_ms": float(calibration.offset_ms.get(sensor, 0.0)),
            "agent_from_sensor": np.asarray(mount).ravel().tolist(),
        }
        if sensor in calibration.intrinsics:
            entry["intrinsics"] = np.asarray(calibration.intrinsics[sensor]).ravel().tolist()
        if sensor in calibration.distortion:
            entry["distortion"] = np.asarray(calibration.distortion[sensor]).ravel().tolist()
    return entries


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
