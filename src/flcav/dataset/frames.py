"""Decoding of table rows into the parts of a frame, the inverse of `flcav.dataset.rows`."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from flcav.config import InputError, parse_config
from flcav.dataset.tables import (
    ACCELERATION_COLUMNS,
    AMODAL_COLUMNS,
    BOX_COLUMNS,
    RECTANGLE_COLUMNS,
    TILT_COLUMNS,
    VELOCITY_COLUMNS,
    VISIBLE_COLUMNS,
    WEATHER_COLUMNS,
)
from flcav.geometry import Boxes
from flcav.sensors.frame import Annotations, SignViews, Views
from flcav.world.weather import Weather


def decode_annotations(
    rows: pa.Table,
    points: pa.Table,
    views: pa.Table,
    signs: pa.Table,
    tilts: pa.Table,
    ranging: Iterable[str],
    cameras: Iterable[str],
) -> Annotations:
    """Return the annotations of one frame from its rows in the tables that its parameters are called by.

    `ranging` names the frame's LiDARs and radars, `cameras` its cameras, infrared ones included. Raises `InputError`
    where a row refers to an actor that is not annotated.
    """
    count, cameras = len(rows), list(cameras)
    return Annotations(
        track=_text(rows, "track"),
        boxes=replace(Boxes.from_array(_numbers(rows, BOX_COLUMNS), _text(rows, "category")), tilt=_tilt(tilts, count)),
        velocity=_numbers(rows, VELOCITY_COLUMNS),
        acceleration=_numbers(rows, ACCELERATION_COLUMNS),
        returns=rows["returns"].to_numpy().copy(),
        occlusion=rows["occlusion"].to_numpy().copy(),
        points={name: _points(_of_sensor(points, name), count) for name in ranging},
        views={name: _view(_of_sensor(views, name), count) for name in cameras},
        signs={name: _signs(_of_sensor(signs, name)) for name in cameras},
    )


def decode_vectors(rows: pa.Table, columns: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Return sensor -> (C,) values of its row in the C `columns`."""
    return dict(zip(rows["sensor"].to_pylist(), _numbers(rows, columns)))


def decode_weather(rows: pa.Table) -> Weather | None:
    """Return the weather of a frame from its row, None without a row; raises `InputError` for values out of range."""
    if not len(rows):
        return None
    row = rows.slice(0, 1).to_pylist()[0]
    return parse_config(Weather, {name: row[name] for name in WEATHER_COLUMNS}, f"the weather of {row['frame']}")


def _points(rows: pa.Table, count: int) -> NDArray[np.int64]:
    points = np.zeros(count, np.int64)
    points[_actors(rows, count)] = rows["points"].to_numpy()
    return points


def _tilt(rows: pa.Table, count: int) -> NDArray[np.float64] | None:
    """Return pitch and roll (count, 2) of the boxes; None where no box is tilted."""
    if not len(rows):
        return None
    tilt, at = np.zeros((count, 2)), rows["row"].to_numpy()
    if ((at < 0) | (at >= count)).any():
        raise InputError(f"{rows['frame'][0].as_py()}: a tilt is of no annotated actor")
    tilt[at] = _numbers(rows, TILT_COLUMNS)
    return tilt


def _actors(rows: pa.Table, count: int) -> NDArray[np.int64]:
    """Return (R,) the indices into the frame's `count` annotations that the R `rows` of another table refer to.

    Raises `InputError` for an index that is out of range.
    """
    at = rows["row"].to_numpy()
    if ((at < 0) | (at >= count)).any():
        raise InputError(
            f"{rows['frame'][0].as_py()}: '{rows['sensor'][0].as_py()}' sees an actor that is not annotated"
        )
    return at


def _view(rows: pa.Table, count: int) -> Views:
    at = _actors(rows, count)

    def filled(values: NDArray, missing: float) -> NDArray:
        column = np.full((count, *values.shape[1:]), missing, values.dtype)
        column[at] = values
        return column

    return Views(
        amodal_box=filled(_numbers(rows, AMODAL_COLUMNS), np.nan),
        visible_box=filled(_numbers(rows, VISIBLE_COLUMNS), np.nan),
        pixels=filled(rows["pixels"].to_numpy(), 0),
        truncation=filled(rows["truncation"].to_numpy(), 1.0),
        occlusion=filled(rows["occlusion"].to_numpy(), 1.0),
    )


def _signs(rows: pa.Table) -> SignViews:
    return SignViews(
        kind=_text(rows, "kind"),
        state=_text(rows, "state"),
        box=_numbers(rows, RECTANGLE_COLUMNS),
        pixels=rows["pixels"].to_numpy().copy(),
        distance_m=rows["distance_m"].to_numpy().copy(),
        thing=rows["thing"].to_numpy().copy(),
    )


def _of_sensor(rows: pa.Table, name: str) -> pa.Table:
    return rows.filter(np.array(rows["sensor"].to_pylist(), dtype=np.str_) == name)


def _text(rows: pa.Table, name: str) -> NDArray[np.str_]:
    return np.array(rows[name].to_pylist(), dtype=np.str_)


def _numbers(rows: pa.Table, names: Sequence[str]) -> NDArray[np.float64]:
    return np.stack([rows[name].to_numpy() for name in names], axis=1)
