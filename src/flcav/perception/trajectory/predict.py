"""Inference of the trajectory network: input and target tensors, batches, single path; forecasts as JSON records."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from flcav.interface.progress import Report, ignore_progress
from flcav.perception.marks import Light, Paths, RoadUser
from flcav.perception.task import Result
from flcav.perception.trajectory.cross_view import Inputs
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.samples import Sample
from flcav.storage.records import Class

Array = NDArray[np.float64]
Point = tuple[float, float]  # x, y in the world [m]

RASTERS, VIEWS = 256, 16  # batch sizes of inference with rasters and with cameras


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
class RoadUserForecast:
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
    agents: tuple[RoadUserForecast, ...]

    def lines(self) -> list[str]:
        """Return one line per road user: its position now and at the end of its single path."""
        lines = []
        for agent in self.agents:
            x, y = agent.modes[0].path[-1]
            said = f"at ({agent.x:.1f}, {agent.y:.1f}), in {self.time_s[-1]:g} s at ({x:.1f}, {y:.1f})"
            lines.append(f"{agent.track} {said}")
        return lines or ["nobody to predict"]


def inputs_of(samples: Sequence[Sample], network: nn.Module) -> Inputs:
    """Return the input tensors of samples on the network's device; with rasters if the samples have no images."""
    device = next(network.parameters()).device
    past = torch.from_numpy(np.stack([sample.past for sample in samples])).to(device)
    seen = [sample.surround for sample in samples if sample.surround is not None]
    if not seen:
        return Inputs(past, raster=rasters_of(samples, device))
    pictures = np.stack([one.pictures for one in seen]).transpose(0, 1, 4, 2, 3)
    return Inputs(
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


def _floats(arrays: list[NDArray[np.float64]], device: torch.device) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32)).to(device)


def predict(
    network: TrajectoryNetwork, samples: Sequence[Sample], progress: Report = ignore_progress
) -> tuple[Array, Array]:
    """Return the forecasts of N samples: paths (N, K, FUTURE, 2) [m] in the samples' frames and probabilities (N, K).

    The network's training mode is left as it was.
    """
    training = network.training
    network.eval()
    paths, probabilities = [], []
    size = VIEWS if network.config.cameras else RASTERS
    with torch.inference_mode():
        for first in range(0, len(samples), size):
            batch = [samples[i] for i in range(first, min(first + size, len(samples)))]
            forecast = network(inputs_of(batch, network))
            paths.append(forecast.paths.double().cpu().numpy())
            probabilities.append(forecast.logits.softmax(dim=1).double().cpu().numpy())
            progress(first + len(batch), len(samples), "")
    network.train(training)
    return np.concatenate(paths), np.concatenate(probabilities)


def find_medoid(paths: Array, probabilities: Array) -> NDArray[np.int64]:
    """Return the index (N,) of the mode that is given as the single path: the medoid of the forecast.

    The medoid is the mode with the least expected average distance to the other modes under the predicted
    probabilities. Unlike the likeliest mode it takes similar modes together. `paths` are (N, K, FUTURE, 2) [m],
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
