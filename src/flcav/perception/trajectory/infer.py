"""Inference on the frames of a dataset: findings with the forecasts, drawn on the map around the observing agent."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.layout import read_manifest
from flcav.dataset.store import Dataset
from flcav.geometry import pose, yaw_of
from flcav.perception.marks import Light, Mode, Paths, RoadUser
from flcav.perception.task import Finding
from flcav.perception.trajectory.config import FUTURE, PAST, STEP_S
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.predict import find_medoid, forecasts, predict
from flcav.perception.trajectory.rasters import OPEN
from flcav.perception.trajectory.roads import STATIC_ROWS, RoadMap, load_roads
from flcav.perception.trajectory.samples import Samples, extract_columns, find_near, find_pictured, load_traffic
from flcav.perception.trajectory.tracks import constant_velocity, into_frame, out_of_frame, tracks_around
from flcav.world.map.lanes import rasterise
from flcav.world.trace import Trace

Array = NDArray[np.float64]

AROUND_M = 50.0  # half side of the map around the observer, and of the square whose vehicles are predicted with rasters
PIXEL_M = 0.2  # resolution of the map
TIMES_S = tuple((STEP_S * np.arange(1, FUTURE + 1)).tolist())  # of the path points, after the present


def forecast_frames(network: TrajectoryNetwork, path: Path, frames: Sequence[int] | None = None) -> Iterator[Finding]:
    """Yield the forecasts of `frames` of the dataset `path` (None: all).

    `Finding.seen` is the map around the observer, (len(STATIC), H, W), row 0 farthest ahead and column 0 farthest left.
    Only vehicles with a recorded past of 2 s are predicted. Raises `InputError` if `path` is no dataset, or one
    without traffic or map.
    """
    read_manifest(path)
    data = Dataset.open(path)
    traces: dict[str, Trace] = {}
    for number in data.numbers(frames):
        key = data.keys[number]
        if key.scene not in traces:
            traces = {key.scene: load_traffic(data, key.scene)}
        trace = traces[key.scene]
        world_from_agent = data.frame(number).world_from_agent
        observer = np.array([*world_from_agent[:2, 3], yaw_of(world_from_agent)])
        found = _predicted(network, data, number, trace, observer)
        yield Finding(path / data.name(number), map_around(load_roads(data), observer), forecasts(found), (found,))


def map_around(roads: RoadMap, observer: Array) -> NDArray[np.bool_]:
    """Return the raster (len(STATIC), H, W) of the map in the square of half side `AROUND_M` around x, y, yaw."""
    middle = pose(float(observer[0]), float(observer[1]), yaw=float(observer[2]))
    return rasterise(roads.layers, middle, (2 * AROUND_M, 2 * AROUND_M), PIXEL_M)[list(STATIC_ROWS)]


def _predicted(network: TrajectoryNetwork, data: Dataset, number: int, trace: Trace, observer: Array) -> Paths:
    key, config = data.keys[number], network.config
    instant = int(np.argmin(np.abs(trace.time_s - key.time_s)))
    tracks = tracks_around(trace, key.time_s)
    if not config.cameras:
        apart = into_frame(tracks.position[None, PAST], observer[None])[0]
        wanted = (np.abs(apart) <= AROUND_M).all(axis=1)
    elif find_pictured(data, number) is None:
        wanted = np.zeros(len(trace.actor), np.bool_)
    else:
        wanted = find_near(trace, tracks, key)
    columns = extract_columns(trace, tracks, key, number, load_roads(data), config.patch, wanted, complete=False)
    users: list[RoadUser] = []
    if len(columns.past):
        paths, probabilities = predict(network, Samples(data, columns, config.cameras))
        first = find_medoid(paths, probabilities)
        present, plain = columns.pose, constant_velocity(columns.past)
        for i, actor in enumerate(columns.actor):
            modes = [Mode(float(share), _in_world(way, present[i])) for share, way in zip(probabilities[i], paths[i])]
            truth = columns.future[i].astype(np.float64)
            users.append(
                RoadUser(
                    str(trace.actor[actor]),
                    str(trace.category[actor]),
                    *present[i].tolist(),
                    speed=float(columns.past[i, -1, 3]),
                    length=float(trace.size[actor, 0]),
                    width=float(trace.size[actor, 1]),
                    modes=(modes.pop(first[i]), *sorted(modes, key=lambda mode: -mode.probability)),
                    constant_velocity=_in_world(plain[i], present[i]),
                    truth=_in_world(truth, present[i]) if np.isfinite(truth).all() else None,
                )
            )
    x, y, yaw = observer.tolist()
    return Paths((x, y, yaw), AROUND_M, TIMES_S, tuple(users), _lights(trace, instant, load_roads(data)))


def _lights(trace: Trace, instant: int, roads: RoadMap) -> tuple[Light, ...]:
    letters = dict(zip(trace.light.tolist(), trace.light_state[instant].tolist()))
    middles = {name: bar.mean(axis=0).tolist() for name, bar in roads.lights.items() if name in letters}
    return tuple(Light(x, y, letters[name] in OPEN) for name, (x, y) in middles.items())


def _in_world(path: Array, present: Array) -> Array:
    return out_of_frame(path[None], present[None])[0]
