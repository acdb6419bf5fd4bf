"""The Parquet tables of a dataset: their columns, and frames to rows and back.

`frames` has one row per frame; `poses` one row per frame; `annotations` one row per frame and actor, in frame order.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.sensors.frame import Annotations, Frame

ROWS_PER_GROUP = 65_536
BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw")
VELOCITY_COLUMNS = ("vx", "vy", "vz")
ACCELERATION_COLUMNS = ("ax", "ay", "az")

SCHEMAS: dict[str, pa.Schema] = {
    "frames": pa.schema(
        [
            ("key", pa.string()),
            ("scene", pa.string()),
            ("index", pa.int64()),  # spin number within the scene
            ("agent", pa.string()),
            ("time_s", pa.float64()),
            ("lidar", pa.list_(pa.string())),  # names of the frame's LiDARs: folders of the point clouds
            ("points", pa.list_(pa.int64())),  # points of each
            ("annotations", pa.int64()),  # rows of the frame in `annotations`
        ]
    ),
    "poses": pa.schema(
        [
            ("frame", pa.string()),
            ("world_from_agent", pa.list_(pa.float64(), 16)),  # row by row
        ]
    ),
    "annotations": pa.schema(
        [
            ("frame", pa.string()),
            ("track", pa.string()),
            ("category", pa.string()),
            *((name, pa.float64()) for name in BOX_COLUMNS),  # geometric centre, world frame [m], [rad]
            *((name, pa.float64()) for name in VELOCITY_COLUMNS),  # world frame [m/s]
            *((name, pa.float64()) for name in ACCELERATION_COLUMNS),  # world frame [m/s^2]
            ("returns", pa.int64()),
            ("occlusion", pa.float64()),
        ]
    ),
}


def frame_table(frame: Frame) -> pa.Table:
    """Return the one row of `frames` that `frame` gives."""
    row = {
        "key": frame.key,
        "scene": frame.scene,
        "index": frame.index,
        "agent": frame.agent,
        "time_s": frame.time_s,
        "lidar": list(frame.lidar),
        "points": [len(points) for points in frame.lidar.values()],
        "annotations": len(frame.annotations),
    }
    return pa.Table.from_pylist([row], schema=SCHEMAS["frames"])


def pose_table(frame: Frame) -> pa.Table:
    """Return the one row of `poses` that `frame` gives."""
    row = {"frame": frame.key, "world_from_agent": frame.world_from_agent.ravel().tolist()}
    return pa.Table.from_pylist([row], schema=SCHEMAS["poses"])


def annotation_table(frame: Frame) -> pa.Table:
    """Return the rows of `annotations` that `frame` gives."""
    truth = frame.annotations
    columns = {
        "frame": [frame.key] * len(truth),
        "track": truth.track.tolist(),
        "category": truth.boxes.label.tolist(),
        **dict(zip(BOX_COLUMNS, truth.boxes.array().T)),
        **dict(zip(VELOCITY_COLUMNS, truth.velocity.T)),
        **dict(zip(ACCELERATION_COLUMNS, truth.acceleration.T)),
        "returns": truth.returns,
        "occlusion": truth.occlusion,
    }
    return pa.table(columns, schema=SCHEMAS["annotations"])


def annotations_of(rows: pa.Table) -> Annotations:
    """Return the annotations that rows of `annotations` hold."""

    def text(name: str) -> np.ndarray:
        return np.array(rows[name].to_pylist(), dtype=np.str_)

    def numbers(names: Sequence[str]) -> np.ndarray:
        return np.stack([rows[name].to_numpy() for name in names], axis=1)

    return Annotations(
        track=text("track"),
        boxes=Boxes.from_array(numbers(BOX_COLUMNS), text("category")),
        velocity=numbers(VELOCITY_COLUMNS),
        acceleration=numbers(ACCELERATION_COLUMNS),
        returns=rows["returns"].to_numpy().copy(),
        occlusion=rows["occlusion"].to_numpy().copy(),
    )


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table so that equal rows give equal bytes."""
    pq.write_table(table.combine_chunks(), path, row_group_size=ROWS_PER_GROUP, compression="zstd")


def read_table(path: Path, name: str) -> pa.Table:
    """Return the table `name` that a file holds; raises `InputError` naming the file where it does not."""
    try:
        table = pq.ParquetFile(path).read()
    except FileNotFoundError:
        raise InputError(f"{path}: missing from the dataset") from None
    except (pa.ArrowException, OSError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"{path}: not a readable Parquet file ({reason})") from None
    if not table.schema.equals(SCHEMAS[name]):
        expected = ", ".join(SCHEMAS[name].names)
        raise InputError(f"{path}: its columns are not those of the table '{name}' ({expected})")
    if any(column.null_count for column in table.columns):
        raise InputError(f"{path}: has empty cells")
    return table.combine_chunks()
