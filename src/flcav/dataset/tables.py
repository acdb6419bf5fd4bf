"""Schemas, writing, concatenation and reading of the Parquet tables of a dataset.

`frames` and `poses` have one row per frame. All other tables have any number of rows per frame, in frame order.
"""

import contextlib
from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from flcav.config import InputError
from flcav.dataset.layout import FILES, Manifest, table_path
from flcav.storage.parquet import read_parquet
from flcav.world.weather import Weather

ROWS_PER_GROUP = 65_536
BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw")
VELOCITY_COLUMNS = ("vx", "vy", "vz")
ACCELERATION_COLUMNS = ("ax", "ay", "az")
AMODAL_COLUMNS = ("amodal_x1", "amodal_y1", "amodal_x2", "amodal_y2")
VISIBLE_COLUMNS = ("visible_x1", "visible_y1", "visible_x2", "visible_y2")
RECTANGLE_COLUMNS = ("x1", "y1", "x2", "y2")
GNSS_COLUMNS = ("latitude_deg", "longitude_deg", "altitude_m")
IMU_COLUMNS = ("force_x", "force_y", "force_z", "rate_x", "rate_y", "rate_z")
WEATHER_COLUMNS = tuple(Weather.model_fields)
TILTS = "tilts"
TILT_COLUMNS = ("pitch", "roll")  # [rad], as in `geometry.pose`
FILES_SCHEMA = pa.schema([("path", pa.string()), ("bytes", pa.int64()), ("sha256", pa.string())])


def _numbers(names: Iterable[str]) -> list[tuple[str, pa.DataType]]:
    return [(name, pa.float64()) for name in names]


SCHEMAS: dict[str, pa.Schema] = {
    "frames": pa.schema(
        [
            ("key", pa.string()),
            ("scene", pa.string()),
            ("index", pa.int64()),  # spin number within the scene
            ("agent", pa.string()),
            ("time_s", pa.float64()),
            ("lidar", pa.list_(pa.string())),  # names of LiDARs, which are folders of point clouds
            ("points", pa.list_(pa.int64())),  # number of points of each LiDAR
            ("radar", pa.list_(pa.string())),
            ("detections", pa.list_(pa.int64())),  # number of detections of each radar
            ("cameras", pa.list_(pa.string())),
            ("infrared", pa.list_(pa.string())),
            ("annotations", pa.int64()),  # number of rows of the frame in `annotations`
        ]
    ),
    "poses": pa.schema(
        [
            ("frame", pa.string()),
            ("world_from_agent", pa.list_(pa.float64(), 16)),  # at the spin, row-major
            ("triggered", pa.list_(pa.string())),  # sensors with another trigger time than the spin
            ("world_from_agent_then", pa.list_(pa.float64())),  # at each of these times, 16 numbers, row-major
        ]
    ),
    "annotations": pa.schema(
        [
            ("frame", pa.string()),
            ("track", pa.string()),
            ("category", pa.string()),
            *_numbers(BOX_COLUMNS),  # geometric centre and size [m], yaw [rad], world frame
            *_numbers(VELOCITY_COLUMNS),  # world frame [m/s]
            *_numbers(ACCELERATION_COLUMNS),  # world frame [m/s^2]
            ("returns", pa.int64()),
            ("occlusion", pa.float64()),
        ]
    ),
    "points": pa.schema(  # number of a sensor's points on each actor that has any
        [
            ("frame", pa.string()),
            ("sensor", pa.string()),  # a LiDAR or a radar
            ("row", pa.int64()),  # index into the frame's annotations
            ("points", pa.int64()),
        ]
    ),
    "views": pa.schema(  # see `Views`; one row for each actor whose amodal box is not NaN
        [
            ("frame", pa.string()),
            ("sensor", pa.string()),  # a camera or an infrared camera
            ("row", pa.int64()),  # index into the frame's annotations
            *_numbers(AMODAL_COLUMNS),
            *_numbers(VISIBLE_COLUMNS),
            ("pixels", pa.int64()),
            ("truncation", pa.float64()),
            ("occlusion", pa.float64()),
        ]
    ),
    "signs": pa.schema(  # see `SignViews`
        [
            ("frame", pa.string()),
            ("sensor", pa.string()),
            ("kind", pa.string()),
            ("state", pa.string()),
            *_numbers(RECTANGLE_COLUMNS),
            ("pixels", pa.int64()),
            ("distance_m", pa.float64()),
            ("thing", pa.int64()),
        ]
    ),
    "gnss": pa.schema([("frame", pa.string()), ("sensor", pa.string()), *_numbers(GNSS_COLUMNS)]),
    "imu": pa.schema([("frame", pa.string()), ("sensor", pa.string()), *_numbers(IMU_COLUMNS)]),
    "weather": pa.schema([("frame", pa.string()), *_numbers(WEATHER_COLUMNS)]),
    TILTS: pa.schema(  # only in datasets with tilted boxes
        [("frame", pa.string()), ("row", pa.int64()), *_numbers(TILT_COLUMNS)]  # index into the frame's annotations
    ),
}


def write_rows(table: pa.Table, path: Path) -> None:
    """Write a table as Parquet with fixed settings, so that equal rows give equal bytes."""
    pq.write_table(table.combine_chunks(), path, row_group_size=ROWS_PER_GROUP, compression="zstd")


def join_tables(parts: Iterable[Path], schema: pa.Schema, path: Path) -> int:
    """Concatenate the Parquet files `parts`, of the same `schema`, into the file `path`; return the number of rows.

    Equal rows give equal bytes. At most a row group and one part are in memory.
    """
    rows = 0
    waiting = schema.empty_table()
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for part in parts:
            waiting = pa.concat_tables([waiting, pq.ParquetFile(part).read()])
            while len(waiting) >= ROWS_PER_GROUP:
                rows += ROWS_PER_GROUP
                writer.write_table(waiting.slice(0, ROWS_PER_GROUP).combine_chunks())
                waiting = waiting.slice(ROWS_PER_GROUP)
        writer.write_table(waiting.combine_chunks())
    return rows + len(waiting)


def read_table(path: Path, name: str) -> pa.Table:
    """Return the table `name` from the file `path`.

    Raises `InputError` that names the file where it is missing or damaged, has other columns, or has null values.
    """
    table = read_parquet(path)
    schema = SCHEMAS.get(name, FILES_SCHEMA)
    if not table.schema.equals(schema):
        raise InputError(f"{path}: its columns are not those of the table '{name}' ({', '.join(schema.names)})")
    if any(column.null_count or _null_elements(column) for column in table.columns):
        raise InputError(f"{path}: has empty cells")
    return table.combine_chunks()


def list_files(folder: Path, manifest: Manifest) -> dict[str, tuple[int, str]]:
    """Return path -> (bytes, SHA-256) of every file that the dataset in `folder` lists, all but the manifest.

    Where the listing is damaged, these are the files of the tables, of which it is one.
    """
    listed = {name: (entry.bytes, entry.sha256) for name, entry in manifest.tables.items()}
    with contextlib.suppress(InputError):
        files = read_table(folder / table_path(FILES), FILES).to_pydict()
        listed |= {name: (size, digest) for name, size, digest in zip(files["path"], files["bytes"], files["sha256"])}
    return listed


def _null_elements(column: pa.ChunkedArray) -> int:
    lists = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
    return pc.call_function("list_flatten", [column]).null_count if lists else 0
