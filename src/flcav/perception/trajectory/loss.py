"""The loss of K modes: the mode that comes nearest learns to come nearer, and that it is the one."""

import torch
from torch import Tensor
from torch.nn import functional

from flcav.perception.trajectory.cross_view import LEARNED
from flcav.perception.trajectory.model import Forecast
from flcav.perception.trajectory.rasters import LAYERS

SHARED = 0.05  # of the loss goes to all modes, so that none is lost: Rupprecht et al., ICCV 2017, eq. 5
MODE_WEIGHT = 1.0


def forecast_loss(forecast: Forecast, future: Tensor) -> Tensor:
    """Return winner-takes-all regression and classification of the modes against `future` (B, FUTURE, 2).

    Metres enter by Huber's loss with a bend at 1 m, so that few paths that are far off do not decide.
    """
    apart = functional.smooth_l1_loss(forecast.paths, future[:, None].expand_as(forecast.paths), reduction="none")
    off = apart.sum(dim=3).mean(dim=2)  # (B, K)
    with torch.no_grad():
        winner = torch.linalg.vector_norm(forecast.paths - future[:, None], dim=3).mean(dim=2).argmin(dim=1)
    won = off.gather(1, winner[:, None])[:, 0]
    regression = ((1 - SHARED) * won + SHARED * off.mean(dim=1)).mean()
    return regression + MODE_WEIGHT * functional.cross_entropy(forecast.logits, winner)


def map_loss(map_logits: Tensor, raster: Tensor) -> Tensor:
    """Return the cross entropy of the learned map (B, LEARNED, h, w) against the raster's layers at its resolution."""
    wanted = raster[:, [LAYERS.index(name) for name in LEARNED]]
    wanted = functional.adaptive_avg_pool2d(wanted, map_logits.shape[-1])
    weight = map_logits.new_tensor(list(LEARNED.values()))[:, None, None]
    return functional.binary_cross_entropy_with_logits(map_logits, wanted, pos_weight=weight)
