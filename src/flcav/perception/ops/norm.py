"""Batch normalisation followed by ReLU, of (B, C, H, W) maps and of (N, C) rows of features.

Rows on a CPU have a separate implementation as one differentiable step, because PyTorch's kernel is several times
slower there on tall, narrow matrices. Equations: Ioffe and Szegedy, "Batch Normalization", ICML 2015, alg. 1, and their
gradient; as there, the running variance is the unbiased one.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class NormReLU(nn.Module):
    """Batch normalisation and ReLU of (N, C) rows or (B, C, H, W) maps; channels-last memory is fastest for maps.

    Running mean and variance follow the batches with weight `momentum`; `epsilon` is added to variances.
    """

    running_mean: Tensor
    running_variance: Tensor

    def __init__(self, channels: int, epsilon: float = 1e-3, momentum: float = 0.1) -> None:
        super().__init__()
        self.epsilon, self.momentum = epsilon, momentum
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_variance", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Return max(0, weight * (x - mean) / deviation + bias), in the shape of x.

        Mean and deviation are those of the batch in training mode, the running ones otherwise.
        """
        if x.dim() == 4 or not _written_out(x):
            known = self.running_mean, self.running_variance, self.weight, self.bias
            return F.batch_norm(x, *known, self.training, self.momentum, self.epsilon).relu_()
        if self.training:
            y, mean, variance = _NormReLU.apply(x, self.weight, self.bias, self.epsilon)
            self._follow(mean, variance, len(x))
            return y
        scale = self.weight * torch.rsqrt(self.running_variance + self.epsilon)
        return torch.addcmul(self.bias - self.running_mean * scale, x, scale).relu_()

    @torch.no_grad()
    def _follow(self, mean: Tensor, variance: Tensor, count: int) -> None:
        if not count:
            return
        self.running_mean.lerp_(mean, self.momentum)
        self.running_variance.lerp_(variance * (count / max(count - 1, 1)), self.momentum)


def _written_out(rows: Tensor) -> bool:
    return rows.device.type == "cpu"


class _NormReLU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, epsilon: float) -> tuple[Tensor, Tensor, Tensor]:
        mean = x.mean(0)
        unit = x - mean
        variance = (unit * unit).mean(0)
        inverse = torch.rsqrt(variance + epsilon)
        unit *= inverse
        y = torch.addcmul(bias, unit, weight).relu_()
        ctx.save_for_backward(unit, y, weight, inverse)
        ctx.mark_non_differentiable(mean, variance)
        return y, mean, variance

    @staticmethod
    # Gradient of Ioffe and Szegedy (2015), p. 4: the mean and variance of the batch depend on every row of x.
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        unit, y, weight, inverse = ctx.saved_tensors
        through = torch.ops.aten.threshold_backward(gradients[0], y, 0)
        grad_bias = through.sum(0)
        grad_weight = (through * unit).sum(0)
        through -= grad_bias / len(y)
        through.addcmul_(unit, grad_weight / -len(y))
        through *= weight * inverse
        return through, grad_weight, grad_bias, None
