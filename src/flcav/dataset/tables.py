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
from flcav.storage.files import read_parquet
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


TEXT, WHOLE, NUMBER = pa.string(), pa.int64(), pa.float64()


def _columns(kind: pa.DataType, *names: str) -> list[tuple[str, pa.DataType]]:
    return [(name, kind) for name in names]


SEEN = _columns(TEXT, "frame", "sensor")
ROW = ("row", WHOLE)  # index into the frame's annotations
SCHEMAS: dict[str, pa.Schema] = {
    "frames": pa.schema(
        [
            *_columns(TEXT, "key", "scene"),
            ("index", WHOLE),  # spin number within the scene
            ("agent", TEXT),
            ("time_s", NUMBER),
            ("lidar", pa.list_(TEXT)),  # names of LiDARs, which are folders of point clouds
            ("points", pa.list_(WHOLE)),  # number of points of each LiDAR
            ("radar", pa.list_(TEXT)),
            ("detections", pa.list_(WHOLE)),  # number of detections of each radar
            *_columns(pa.list_(TEXT), "cameras", "infrared"),
            ("annotations", WHOLE),  # number of rows of the frame in `annotations`
        ]
    ),
    "poses": pa.schema(
        [
            ("frame", TEXT),
            ("world_from_agent", pa.list_(NUMBER, 16)),  # at the spin, row-major
            ("triggered", pa.list_(TEXT)),  # sensors with another trigger time than the spin
            ("world_from_agent_then", pa.list_(NUMBER)),  # at each of these times, 16 numbers, row-major
        ]
    ),
    "annotations": pa.schema(
        [
            *_columns(TEXT, "frame", "track", "category"),
            *_columns(NUMBER, *BOX_COLUMNS),  # geometric centre and size [m], yaw [rad], world frame
            *_columns(NUMBER, *VELOCITY_COLUMNS, *ACCELERATION_COLUMNS),  # world frame [m/s], [m/s^2]
            ("returns", WHOLE),
            ("occlusion", NUMBER),
        ]
    ),
    # number of points of a LiDAR or a radar on each actor that has any
    "points": pa.schema([*SEEN, ROW, ("points", WHOLE)]),
    "views": pa.schema(  # see `Views`; one row for each actor whose amodal box is not NaN, infrared cameras included
        [
            *(*SEEN, ROW, *_columns(NUMBER, *AMODAL_COLUMNS, *VISIBLE_COLUMNS)),
            *(("pixels", WHOLE), *_columns(NUMBER, "truncation", "occlusion")),
        ]
    ),
    "signs": pa.schema(  # see `SignViews`
        [
            *(*SEEN, *_columns(TEXT, "kind", "state"), *_columns(NUMBER, *RECTANGLE_COLUMNS)),
            *(("pixels", WHOLE), ("distance_m", NUMBER), ("thing", WHOLE)),
        ]
    ),
    "gnss": pa.schema([*SEEN, *_columns(NUMBER, *GNSS_COLUMNS)]),
    "imu": pa.schema([*SEEN, *_columns(NUMBER, *IMU_COLUMNS)]),
    "weather": pa.schema([("frame", TEXT), *_columns(NUMBER, *WEATHER_COLUMNS)]),
    TILTS: pa.schema([("frame", TEXT), ROW, *_columns(NUMBER, *TILT_COLUMNS)]),  # only in datasets with tilted boxes
}


def write_rows(table: pa.Table, path: Path) -> None:
    """Write a table as Parquet with fixed settings, so that equal rows give equal bytes."""
    pq.write_table(table.combine_chunks(), path, row_group_size=ROWS_PER_GROUP, compression="zstd")


def join_tables(parts: Iterable[Path], schema: pa.Schema, path: Path) -> int:
    """Concatenate the Parquet files `parts`, all of `schema`, into the file `path`; return the number of rows.

    Equal rows give equal bytes, however they are divided into parts. At most a row group and one part are in memory.
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

    Raises `InputError`, naming the file, where it is missing or damaged, has other columns, or has null values.
    """
    table = read_parquet(path)
    schema = SCHEMAS.get(name, FILES_SCHEMA)
    if not table.schema.equals(schema):
        raise InputError(f"{path}: its columns are not those of the table '{name}' ({', '.join(schema.names)})")
    if any(column.null_count or _null_elements(column) for column in table.columns):
        raise InputError(f"{path}: has empty cells")
    return table.combine_chunks()


def list_files(folder: Path, manifest: Manifest) -> dict[str, tuple[int, str]]:
    """Return the size [bytes] and SHA-256 checksum of all files that a dataset lists, by path, except the manifest.

    Where the listing is damaged, only the files of the tables, the listing among them, are returned.
    """
    listed = {name: (entry.bytes, entry.sha256) for name, entry in manifest.tables.items()}
    with contextlib.suppress(InputError):
        files = read_table(folder / table_path(FILES), FILES).to_pydict()
        listed |= {name: (size, digest) for name, size, digest in zip(files["path"], files["bytes"], files["sha256"])}
    return listed


def _null_elements(column: pa.ChunkedArray) -> int:
    lists = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
    return pc.call_function("list_flatten", [column]).null_count if lists else 0
