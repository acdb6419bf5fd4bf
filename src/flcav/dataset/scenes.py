"""One scene of a source to a folder of its own: complete, or not there."""

import hashlib
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa

from flcav.dataset.layout import CALIBRATION, TRACES, points_path, table_path, trace_path
from flcav.dataset.tables import SCHEMAS, annotation_table, frame_table, pose_table, write_table
from flcav.files import sha256, write_json
from flcav.sensors.frame import Frame
from flcav.sources.source import Source

FILES = "files"  # folder of what goes into the dataset as it is, and with .json, its listing
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


def write_scene(source: Source, scene: str, work: Path, wrote_frame: Callable[[], None]) -> None:
    """Write `scene` to `work/scene`, which appears only when whole; calls `wrote_frame` after each frame."""
    part = work / f"{scene}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    listing: dict[str, dict[str, str | int]] = {}
    rows: dict[str, list[pa.Table]] = {name: [schema.empty_table()] for name, schema in SCHEMAS.items()}
    calibration: dict[str, dict[str, list[float]]] = {}

    for frame in source.frames(scene):
        _check_names(frame, scene, listing)
        for lidar, points in frame.lidar.items():
            name = points_path(lidar, frame.key)
            listing[name] = _write_points(part / FILES / name, points)
        rows["frames"].append(frame_table(frame))
        rows["poses"].append(pose_table(frame))
        rows["annotations"].append(annotation_table(frame))
        mounts = {name: matrix.ravel().tolist() for name, matrix in frame.agent_from_sensor.items()}
        if calibration.setdefault(frame.agent, mounts) != mounts:
            raise ValueError(f"{frame.key}: the sensors of {frame.agent} moved on their mounts within a dataset")
        wrote_frame()

    trace = source.trace(scene)
    if trace is not None:
        path = part / FILES / trace_path(scene)
        path.parent.mkdir(parents=True)
        trace.save(path)
        listing[trace_path(scene)] = {"bytes": path.stat().st_size, "sha256": sha256(path)}
    for name, tables in rows.items():
        write_table(pa.concat_tables(tables), part / table_path(name))
    write_json(part / CALIBRATION, calibration)
    write_json(part / f"{FILES}.json", listing)
    part.rename(work / scene)


def _write_points(path: Path, points: np.ndarray) -> dict[str, str | int]:
    data = np.ascontiguousarray(points, dtype="<f4").tobytes()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _check_names(frame: Frame, scene: str, listing: dict) -> None:
    names = (frame.key, *frame.lidar)
    if frame.scene != scene or TRACES in frame.lidar or not all(_SAFE_NAME.fullmatch(name) for name in names):
        raise ValueError(f"{frame.key}: scene, agent or sensor names that a dataset cannot hold: {names}")
    if any(points_path(lidar, frame.key) in listing for lidar in frame.lidar):
        raise ValueError(f"{frame.key}: the source yields this frame twice")
