"""Loss of the trajectory network: winner-takes-all regression, mode classification, and map segmentation."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from flcav.perception.trajectory.cross_view import LEARNED
from flcav.perception.trajectory.model import ForecastTensors, TrajectoryNetwork
from flcav.perception.trajectory.predict import futures_of, inputs_of, rasters_of
from flcav.perception.trajectory.rasters import LAYERS
from flcav.perception.trajectory.samples import Sample

SHARED = 0.05  # share of the regression over all modes, against unused modes: Rupprecht et al., ICCV 2017, eq. 5
MODE_WEIGHT = 1.0  # weight of the mode classification


def batch_loss(network: TrajectoryNetwork, samples: Sequence[Sample]) -> Tensor:
    """Return the loss of the forecast, with cameras plus the weighted loss of the map's segmentation."""
    inputs = inputs_of(samples, network)
    forecast = network(inputs)
    loss = forecast_loss(forecast, futures_of(samples, inputs.past.device))
    if forecast.map_logits is None or network.config.cameras is None:
        return loss
    taught = map_loss(forecast.map_logits, rasters_of(samples, inputs.past.device))
    return loss + network.config.cameras.map_weight * taught


def forecast_loss(forecast: ForecastTensors, future: Tensor) -> Tensor:
    """Return the winner-takes-all regression and the mode classification against `future` (B, FUTURE, 2) [m].

    The winner is the mode with the smallest average displacement error. Regression is Huber's loss with threshold 1 m,
    which limits the influence of outliers; classification is the cross entropy of the modes' logits.
    """
    apart = functional.smooth_l1_loss(forecast.paths, future[:, None].expand_as(forecast.paths), reduction="none")
    off = apart.sum(dim=3).mean(dim=2)  # (B, K)
    with torch.no_grad():
        winner = torch.linalg.vector_norm(forecast.paths - future[:, None], dim=3).mean(dim=2).argmin(dim=1)
    won = off.gather(1, winner[:, None])[:, 0]
    regression = ((1 - SHARED) * won + SHARED * off.mean(dim=1)).mean()
    return regression + MODE_WEIGHT * functional.cross_entropy(forecast.logits, winner)


def map_loss(map_logits: Tensor, raster: Tensor) -> Tensor:
    """Return the weighted binary cross entropy of map logits (B, LEARNED, h, w) against the raster's layers.

    `raster` (B, LAYERS, cells, cells) is averaged to the resolution of the logits.
    """
    wanted = raster[:, [LAYERS.index(name) for name in LEARNED]]
    wanted = functional.adaptive_avg_pool2d(wanted, map_logits.shape[-1])
    weight = map_logits.new_tensor(list(LEARNED.values()))[:, None, None]
    return functional.binary_cross_entropy_with_logits(map_logits, wanted, pos_weight=weight)
