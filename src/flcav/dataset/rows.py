"""Frames as rows of the dataset's tables: `encode_frame` writes them, `decode_*` read them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from flcav.config import InputError, Json, parse_config
from flcav.dataset.tables import (
    ACCELERATION_COLUMNS,
    AMODAL_COLUMNS,
    BOX_COLUMNS,
    GNSS_COLUMNS,
    IMU_COLUMNS,
    RECTANGLE_COLUMNS,
    SCHEMAS,
    TILT_COLUMNS,
    TILTS,
    VELOCITY_COLUMNS,
    VISIBLE_COLUMNS,
    WEATHER_COLUMNS,
)
from flcav.geometry import Array, Boxes
from flcav.sensors.frame import Annotations, Frame, SignViews, Views
from flcav.world.weather import Weather

Column = Sequence[Json] | NDArray
Columns = Mapping[str, Column]


def encode_frame(frame: Frame) -> dict[str, Columns]:
    """Return the rows of `frame` as columns, by table; tables of sensors that the frame lacks are left out.

    Columns are lists or arrays of equal length, by column name: see `flcav.dataset.tables.SCHEMAS`.
    """
    truth = frame.annotations
    parts = {"views": truth.views, "signs": truth.signs, "points": truth.points, "gnss": frame.gnss, "imu": frame.imu}
    return {name: columns(frame) for name, columns in COLUMNS.items() if parts.get(name, True)}


def build_table(name: str, parts: Sequence[Columns]) -> pa.Table:
    """Return the Arrow table `name` with the rows of all `parts`, in order."""
    schema = SCHEMAS[name]
    return pa.table({column: _stack([part[column] for part in parts]) for column in schema.names}, schema=schema)


def _stack(parts: Sequence[Column]) -> Column:
    arrays = [part for part in parts if isinstance(part, np.ndarray)]
    if parts and len(arrays) == len(parts):
        return np.concatenate(arrays)
    return [value for part in parts for value in part]


def _frames(frame: Frame) -> Columns:
    return {
        "key": [frame.key],
        "scene": [frame.scene],
        "index": [frame.index],
        "agent": [frame.agent],
        "time_s": [frame.time_s],
        "lidar": [list(frame.lidar)],
        "points": [[len(points) for points in frame.lidar.values()]],
        "radar": [list(frame.radar)],
        "detections": [[len(detections) for detections in frame.radar.values()]],
        "cameras": [list(frame.images)],
        "infrared": [list(frame.infrared)],
        "annotations": [len(frame.annotations)],
    }


def _poses(frame: Frame) -> Columns:
    then = [matrix.ravel() for matrix in frame.agent_at_trigger.values()]
    return {
        "frame": [frame.key],
        "world_from_agent": [frame.world_from_agent.ravel().tolist()],
        "triggered": [list(frame.agent_at_trigger)],
        "world_from_agent_then": [np.concatenate(then).tolist() if then else []],
    }


def _annotations(frame: Frame) -> Columns:
    truth = frame.annotations
    return {
        "frame": [frame.key] * len(truth),
        "track": truth.track.tolist(),
        "category": truth.boxes.label.tolist(),
        **dict(zip(BOX_COLUMNS, truth.boxes.array().T)),
        **dict(zip(VELOCITY_COLUMNS, truth.velocity.T)),
        **dict(zip(ACCELERATION_COLUMNS, truth.acceleration.T)),
        "returns": truth.returns,
        "occlusion": truth.occlusion,
    }


def _points(frame: Frame) -> Columns:
    rows = {name: np.flatnonzero(counts) for name, counts in frame.annotations.points.items()}
    return {
        **_named(frame, {name: len(indices) for name, indices in rows.items()}),
        "row": _joined([*rows.values()], np.int64),
        "points": _joined([frame.annotations.points[name][indices] for name, indices in rows.items()], np.int64),
    }


def _views(frame: Frame) -> Columns:
    views = frame.annotations.views
    rows = {name: np.flatnonzero(~np.isnan(view.amodal_box).any(axis=1)) for name, view in views.items()}

    def column(values: Callable[[Views], np.ndarray], dtype: type) -> np.ndarray:
        return _joined([values(views[name])[indices] for name, indices in rows.items()], dtype)

    return {
        **_named(frame, {name: len(indices) for name, indices in rows.items()}),
        "row": _joined([*rows.values()], np.int64),
        **{name: column(lambda view, i=i: view.amodal_box[:, i], np.float64) for i, name in enumerate(AMODAL_COLUMNS)},
        **{
            name: column(lambda view, i=i: view.visible_box[:, i], np.float64) for i, name in enumerate(VISIBLE_COLUMNS)
        },
        "pixels": column(lambda view: view.pixels, np.int64),
        "truncation": column(lambda view: view.truncation, np.float64),
        "occlusion": column(lambda view: view.occlusion, np.float64),
    }


def _signs(frame: Frame) -> Columns:
    signs = frame.annotations.signs

    def column(values: Callable[[SignViews], np.ndarray], dtype: type) -> np.ndarray:
        return _joined([values(seen) for seen in signs.values()], dtype)

    return {
        **_named(frame, {name: len(seen) for name, seen in signs.items()}),
        "kind": [kind for seen in signs.values() for kind in seen.kind.tolist()],
        "state": [state for seen in signs.values() for state in seen.state.tolist()],
        **{name: column(lambda seen, i=i: seen.box[:, i], np.float64) for i, name in enumerate(RECTANGLE_COLUMNS)},
        "pixels": column(lambda seen: seen.pixels, np.int64),
        "distance_m": column(lambda seen: seen.distance_m, np.float64),
        "thing": column(lambda seen: seen.thing, np.int64),
    }


def _gnss(frame: Frame) -> Columns:
    return {**_named(frame, dict.fromkeys(frame.gnss, 1)), **_stacked(frame.gnss, GNSS_COLUMNS)}


def _imu(frame: Frame) -> Columns:
    return {**_named(frame, dict.fromkeys(frame.imu, 1)), **_stacked(frame.imu, IMU_COLUMNS)}


def _weather(frame: Frame) -> Columns:
    known = [] if frame.weather is None else [frame.weather]
    return {
        "frame": [frame.key] * len(known),
        **{name: [float(getattr(weather, name)) for weather in known] for name in WEATHER_COLUMNS},
    }


def _tilts(frame: Frame) -> Columns:
    tilt = frame.annotations.boxes.tilt
    rows = np.zeros((0, 2)) if tilt is None else tilt
    return {
        "frame": [frame.key] * len(rows),
        "row": np.arange(len(rows), dtype=np.int64),
        **dict(zip(TILT_COLUMNS, rows.T)),
    }


COLUMNS: dict[str, Callable[[Frame], Columns]] = {
    "frames": _frames,
    "poses": _poses,
    "annotations": _annotations,
    "points": _points,
    "views": _views,
    "signs": _signs,
    "gnss": _gnss,
    "imu": _imu,
    "weather": _weather,
    TILTS: _tilts,
}


def _named(frame: Frame, counts: Mapping[str, int]) -> Columns:
    """Return the columns `frame` and `sensor`; `counts` holds the number of rows by sensor."""
    sensors = [name for name, count in counts.items() for _ in range(count)]
    return {"frame": [frame.key] * len(sensors), "sensor": sensors}


def _stacked(values: Mapping[str, np.ndarray], names: tuple[str, ...]) -> Columns:
    rows = np.array(list(values.values()), np.float64).reshape(-1, len(names))
    return dict(zip(names, rows.T))


def _joined(parts: list[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype), *parts]).astype(dtype)


def decode_annotations(
    rows: pa.Table,
    points: pa.Table,
    views: pa.Table,
    signs: pa.Table,
    tilts: pa.Table,
    ranging: Iterable[str],
    cameras: Iterable[str],
) -> Annotations:
    """Return the annotations of a frame from its rows in the tables after which the parameters are named.

    `ranging` names the frame's LiDARs and radars, `cameras` its cameras, infrared ones included. Raises `InputError`
    where a row refers to an actor that is not annotated.
    """
    count = len(rows)
    cameras = list(cameras)
    return Annotations(
        track=_text(rows, "track"),
        boxes=replace(
            Boxes.from_array(_values_of(rows, BOX_COLUMNS), _text(rows, "category")), tilt=_decode_tilt(tilts, count)
        ),
        velocity=_values_of(rows, VELOCITY_COLUMNS),
        acceleration=_values_of(rows, ACCELERATION_COLUMNS),
        returns=rows["returns"].to_numpy().copy(),
        occlusion=rows["occlusion"].to_numpy().copy(),
        points={name: _decode_points(_of_sensor(points, name), count) for name in ranging},
        views={name: _decode_view(_of_sensor(views, name), count) for name in cameras},
        signs={name: _decode_signs(_of_sensor(signs, name)) for name in cameras},
    )


def decode_vectors(rows: pa.Table, columns: Sequence[str]) -> dict[str, Array]:
    """Return the values (C,) of each sensor's row in the C `columns`, by sensor."""
    return dict(zip(rows["sensor"].to_pylist(), _values_of(rows, columns)))


def decode_weather(rows: pa.Table) -> Weather | None:
    """Return the weather of a frame from its row, None without one; raises `InputError` for values out of range."""
    if not len(rows):
        return None
    row = rows.slice(0, 1).to_pylist()[0]
    return parse_config(Weather, {name: row[name] for name in WEATHER_COLUMNS}, f"the weather of {row['frame']}")


def _decode_points(rows: pa.Table, count: int) -> NDArray[np.int64]:
    points = np.zeros(count, np.int64)
    points[_actors(rows, count)] = rows["points"].to_numpy()
    return points


def _decode_tilt(rows: pa.Table, count: int) -> Array | None:
    """Return the pitch and roll (count, 2) [rad] of the boxes; None where no box is tilted."""
    if not len(rows):
        return None
    tilt = np.zeros((count, 2))
    at = rows["row"].to_numpy()
    if ((at < 0) | (at >= count)).any():
        raise InputError(f"{rows['frame'][0].as_py()}: a tilt is of no annotated actor")
    tilt[at] = _values_of(rows, TILT_COLUMNS)
    return tilt


def _actors(rows: pa.Table, count: int) -> NDArray[np.int64]:
    """Return the indices (R,) into the frame's `count` annotations to which the R `rows` of another table refer.

    Raises `InputError` for an index out of range.
    """
    at = rows["row"].to_numpy()
    if ((at < 0) | (at >= count)).any():
        raise InputError(
            f"{rows['frame'][0].as_py()}: '{rows['sensor'][0].as_py()}' sees an actor that is not annotated"
        )
    return at


def _decode_view(rows: pa.Table, count: int) -> Views:
    at = _actors(rows, count)

    def filled(values: NDArray, missing: float) -> NDArray:
        column = np.full((count, *values.shape[1:]), missing, values.dtype)
        column[at] = values
        return column

    return Views(
        amodal_box=filled(_values_of(rows, AMODAL_COLUMNS), np.nan),
        visible_box=filled(_values_of(rows, VISIBLE_COLUMNS), np.nan),
        pixels=filled(rows["pixels"].to_numpy(), 0),
        truncation=filled(rows["truncation"].to_numpy(), 1.0),
        occlusion=filled(rows["occlusion"].to_numpy(), 1.0),
    )


def _decode_signs(rows: pa.Table) -> SignViews:
    return SignViews(
        kind=_text(rows, "kind"),
        state=_text(rows, "state"),
        box=_values_of(rows, RECTANGLE_COLUMNS),
        pixels=rows["pixels"].to_numpy().copy(),
        distance_m=rows["distance_m"].to_numpy().copy(),
        thing=rows["thing"].to_numpy().copy(),
    )


def _of_sensor(rows: pa.Table, name: str) -> pa.Table:
    return rows.filter(np.array(rows["sensor"].to_pylist(), dtype=np.str_) == name)


def _text(rows: pa.Table, name: str) -> NDArray[np.str_]:
    return np.array(rows[name].to_pylist(), dtype=np.str_)


def _values_of(rows: pa.Table, names: Sequence[str]) -> Array:
    return np.stack([rows[name].to_numpy() for name in names], axis=1)
