"""Inference of the trajectory network: tensors in and out, batches, single path, and findings of a dataset's frames.

Findings are the forecasts, drawn on the map around the observing agent, with their JSON record.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from flcav.arrays import Array, Ints, Mask
from flcav.dataset.layout import read_manifest
from flcav.dataset.store import Dataset
from flcav.geometry import pose, yaw_of
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.device import inference
from flcav.perception.marks import Light, Mode, Paths, RoadUser
from flcav.perception.task import Finding, Result
from flcav.perception.trajectory.config import FUTURE, PAST, STEP_S
from flcav.perception.trajectory.model import ForecastInputs, TrajectoryNetwork
from flcav.perception.trajectory.rasters import OPEN, STATIC_ROWS, RoadMap, load_roads
from flcav.perception.trajectory.samples import Sample, Samples, extract_columns, find_near, find_pictured, load_traffic
from flcav.perception.trajectory.tracks import constant_velocity, into_frame, out_of_frame, tracks_around
from flcav.storage.records import Class
from flcav.world.map.lanes import rasterise
from flcav.world.trace import Trace

Point = tuple[float, float]  # x, y in the world [m]

RASTERS, VIEWS = 256, 16  # batch sizes of inference with rasters and with cameras


@dataclass(frozen=True)
class Pose2D:
    """A 2D pose in the world frame."""

    x: float  # world [m]
    y: float
    yaw: float  # [rad]


@dataclass(frozen=True)
class ForecastMode:
    """A mode of a forecast."""

    probability: float
    path: tuple[Point, ...]  # positions at `Forecasts.time_s`


@dataclass(frozen=True, kw_only=True)
class RoadUserForecast:
    """The forecast of a road user: the JSON record of a `RoadUser`."""

    track: str
    label: Class
    x: float  # world [m]
    y: float
    yaw: float  # [rad]
    speed: float  # [m/s]
    length: float  # [m]
    width: float
    modes: tuple[ForecastMode, ...]  # first the single path (the medoid), then the others by decreasing probability
    constant_velocity: tuple[Point, ...] | None  # path at constant heading and speed
    truth: tuple[Point, ...] | None  # the recorded path; None if not recorded


@dataclass(frozen=True)
class Forecasts(Result):
    """The forecasts of a frame."""

    time_s: tuple[float, ...]  # times of the points of every path, after the present
    observer: Pose2D
    lights: tuple[Light, ...]
    agents: tuple[RoadUserForecast, ...]

    def lines(self) -> list[str]:
        """Return one line per road user: its position now and at the end of its single path."""
        lines = []
        for agent in self.agents:
            x, y = agent.modes[0].path[-1]
            positions = f"at ({agent.x:.1f}, {agent.y:.1f}), in {self.time_s[-1]:g} s at ({x:.1f}, {y:.1f})"
            lines.append(f"{agent.track} {positions}")
        return lines or ["nobody to predict"]


def inputs_of(samples: Sequence[Sample], network: nn.Module) -> ForecastInputs:
    """Return the input tensors of samples on the network's device; with rasters if the samples have no images."""
    device = next(network.parameters()).device
    past = torch.from_numpy(np.stack([sample.past for sample in samples])).to(device)
    seen = [sample.surround for sample in samples if sample.surround is not None]
    if not seen:
        return ForecastInputs(past, raster=rasters_of(samples, device))
    pictures = np.stack([one.pictures for one in seen]).transpose(0, 1, 4, 2, 3)
    return ForecastInputs(
        past,
        pictures=torch.from_numpy(np.ascontiguousarray(pictures)).to(device).float() / 127.5 - 1,
        intrinsics=_floats([one.intrinsics for one in seen], device),
        camera_from_frame=_floats([one.camera_from_frame for one in seen], device),
    )


def rasters_of(samples: Sequence[Sample], device: torch.device) -> Tensor:
    """Return the rasters (B, LAYERS, cells, cells) of samples, of zeros and ones in float32."""
    bits = np.unpackbits(np.stack([sample.raster for sample in samples]), axis=-1)
    return torch.from_numpy(bits).to(device).float()


def futures_of(samples: Sequence[Sample], device: torch.device) -> Tensor:
    """Return the ground-truth futures (B, FUTURE, 2) [m] of samples."""
    return torch.from_numpy(np.stack([sample.future for sample in samples])).to(device)


def _floats(arrays: list[Array], device: torch.device) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32)).to(device)


def predict_paths(
    network: TrajectoryNetwork, samples: Sequence[Sample], progress: Report = ignore_progress
) -> tuple[Array, Array]:
    """Return the forecasts of N samples: paths (N, K, FUTURE, 2) [m] in the samples' frames and probabilities (N, K).

    The network's training mode is restored.
    """
    paths, probabilities = [], []
    size = VIEWS if network.config.cameras else RASTERS
    with inference(network):
        for first in range(0, len(samples), size):
            batch = [samples[i] for i in range(first, min(first + size, len(samples)))]
            forecast = network(inputs_of(batch, network))
            paths.append(forecast.paths.double().cpu().numpy())
            probabilities.append(forecast.logits.softmax(dim=1).double().cpu().numpy())
            progress(first + len(batch), len(samples), "")
    return np.concatenate(paths), np.concatenate(probabilities)


def find_medoid(paths: Array, probabilities: Array) -> Ints:
    """Return the index (N,) of the mode that is given as the single path: the medoid of the forecast.

    The medoid is the mode with the least expected average distance to the other modes under the predicted
    probabilities. Unlike the likeliest mode it accounts for similar modes together. `paths` are (N, K, FUTURE, 2) [m],
    `probabilities` (N, K).
    """
    apart = np.linalg.norm(paths[:, :, None] - paths[:, None], axis=4).mean(axis=3)  # (N, K, K)
    return (apart * probabilities[:, None]).sum(axis=2).argmin(axis=1)


def forecasts(paths: Paths) -> Forecasts:
    """Return the JSON record of the forecasts of a frame."""
    x, y, yaw = paths.observer
    return Forecasts(paths.times_s, Pose2D(x, y, yaw), paths.lights, tuple(map(_forecast, paths.users)))


def _forecast(user: RoadUser) -> RoadUserForecast:
    return RoadUserForecast(
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


AROUND_M = 50.0  # half side of the map around the observer, and of the square of predicted vehicles with rasters
PIXEL_M = 0.2  # resolution of the map
TIMES_S = tuple((STEP_S * np.arange(1, FUTURE + 1)).tolist())  # times of the path points after the present [s]


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
        predicted = _predicted(network, data, number, trace, observer)
        yield Finding(
            path / data.name(number), map_around(load_roads(data), observer), forecasts(predicted), (predicted,)
        )


def map_around(roads: RoadMap, observer: Array) -> Mask:
    """Return the raster (len(STATIC), H, W) of the map within `AROUND_M` of x, y, yaw [m, rad] to each side."""
    middle = pose(float(observer[0]), float(observer[1]), yaw=float(observer[2]))
    return rasterise(roads.layers, middle, (2 * AROUND_M, 2 * AROUND_M), PIXEL_M)[list(STATIC_ROWS)]


def _predicted(network: TrajectoryNetwork, data: Dataset, number: int, trace: Trace, observer: Array) -> Paths:
    key = data.keys[number]
    config = network.config
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
        paths, probabilities = predict_paths(network, Samples(data, columns, config.cameras))
        first = find_medoid(paths, probabilities)
        present = columns.pose
        plain = constant_velocity(columns.past)
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
