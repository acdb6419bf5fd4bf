"""Forecasts for the frames of a dataset, as records and as marks on the map around the observing agent."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.layout import read_manifest
from flcav.dataset.store import Dataset
from flcav.geometry import pose, yaw_of
from flcav.perception.marks import Light, Mode, Paths, RoadUser
from flcav.perception.task import Finding, Result
from flcav.perception.trajectory.config import FUTURE, STEP_S
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.predict import find_medoid, predict
from flcav.perception.trajectory.rasters import OPEN
from flcav.perception.trajectory.roads import STATIC_ROWS, RoadMap, load_roads
from flcav.perception.trajectory.samples import Samples, extract_columns, find_near, load_traffic
from flcav.perception.trajectory.tracks import constant_velocity, into_frame, out_of_frame
from flcav.records import Class
from flcav.world.map.lanes import rasterise
from flcav.world.trace import Trace

Array = NDArray[np.float64]
Point = tuple[float, float]  # x, y in the world [m]

AROUND_M = 50.0  # half side of the map around the observer, and of the square whose vehicles are predicted with rasters
PIXEL_M = 0.2  # resolution of the map
TIMES_S = tuple((STEP_S * np.arange(1, FUTURE + 1)).tolist())  # of the path points, after the present


@dataclass(frozen=True)
class Pose2D:
    """A 2D pose in the world."""

    x: float  # world [m]
    y: float
    yaw: float  # [rad]


@dataclass(frozen=True)
class ForecastMode:
    """One mode of a forecast."""

    probability: float
    path: tuple[Point, ...]  # positions at `Forecasts.time_s`


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """The forecast of one road user: the JSON record of a `RoadUser`."""

    track: str
    label: Class
    x: float  # world [m]
    y: float
    yaw: float  # [rad]
    speed: float  # [m/s]
    length: float  # [m]
    width: float
    modes: tuple[ForecastMode, ...]  # the first is the single path (the medoid), the others follow by probability
    constant_velocity: tuple[Point, ...] | None  # path at constant heading and speed
    truth: tuple[Point, ...] | None  # path that was driven; None if not recorded


@dataclass(frozen=True)
class Forecasts(Result):
    """The forecasts of a frame."""

    time_s: tuple[float, ...]  # times of the points of every path, after the present
    observer: Pose2D
    lights: tuple[Light, ...]
    agents: tuple[Forecast, ...]

    def lines(self) -> list[str]:
        """Return one line per road user: its position now and at the end of its single path."""
        lines = []
        for agent in self.agents:
            x, y = agent.modes[0].path[-1]
            said = f"at ({agent.x:.1f}, {agent.y:.1f}), in {self.time_s[-1]:g} s at ({x:.1f}, {y:.1f})"
            lines.append(f"{agent.track} {said}")
        return lines or ["nobody to predict"]


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


def forecasts(paths: Paths) -> Forecasts:
    """Return the JSON record of the forecasts of a frame."""
    x, y, yaw = paths.observer
    return Forecasts(paths.times_s, Pose2D(x, y, yaw), paths.lights, tuple(map(_forecast, paths.users)))


def _forecast(user: RoadUser) -> Forecast:
    return Forecast(
        track=user.track,
        label=user.label,
        x=user.x,
        y=user.y,
        yaw=user.yaw,
        speed=user.speed,
        length=user.length,
        width=user.width,
        modes=tuple(ForecastMode(mode.probability, _points(mode.path)) for mode in user.modes),
        constant_velocity=None if user.constant_velocity is None else _points(user.constant_velocity),
        truth=None if user.truth is None else _points(user.truth),
    )


def _points(path: Array) -> tuple[Point, ...]:
    return tuple((x, y) for x, y in path.tolist())


def map_around(roads: RoadMap, observer: Array) -> NDArray[np.bool_]:
    """Return the raster (len(STATIC), H, W) of the map in the square of half side `AROUND_M` around x, y, yaw."""
    middle = pose(float(observer[0]), float(observer[1]), yaw=float(observer[2]))
    return rasterise(roads.layers, middle, (2 * AROUND_M, 2 * AROUND_M), PIXEL_M)[list(STATIC_ROWS)]


def _predicted(network: TrajectoryNetwork, data: Dataset, number: int, trace: Trace, observer: Array) -> Paths:
    key, config = data.keys[number], network.config
    instant = int(np.argmin(np.abs(trace.time_s - key.time_s)))
    if config.cameras:
        wanted = find_near(trace, key)
    else:
        apart = into_frame(trace.position[None, instant, :, :2], observer[None])[0]
        wanted = (np.abs(apart) <= AROUND_M).all(axis=1)
    columns = extract_columns(trace, key.time_s, load_roads(data), config.patch, wanted, complete=False)
    count = len(columns["past"])
    columns |= {"scene": np.full(count, key.scene), "frame": np.full(count, number)}
    users: list[RoadUser] = []
    if count:
        paths, probabilities = predict(network, Samples(data, columns, config.cameras))
        first = find_medoid(paths, probabilities)
        present, plain = columns["pose"], constant_velocity(columns["past"])
        for i, actor in enumerate(columns["actor"]):
            modes = [Mode(float(share), _in_world(way, present[i])) for share, way in zip(probabilities[i], paths[i])]
            truth = columns["future"][i].astype(np.float64)
            users.append(
                RoadUser(
                    str(trace.actor[actor]),
                    str(trace.category[actor]),
                    *present[i].tolist(),
                    speed=float(columns["past"][i, -1, 3]),
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
