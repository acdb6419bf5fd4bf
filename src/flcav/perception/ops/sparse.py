"""Sparse 3D convolution in plain PyTorch: gather, one matrix product per kernel offset, sum by target voxel.

The sum by target is an `embedding_bag`, which reads each product once in target order; adding by index would write
scattered rows. Both directions are written out, and only the input features are kept for the backward pass.
"""

import math
import threading
from dataclasses import dataclass, field, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from flcav.perception.ops.rules import Groups, Rules, Triple, cells_of, strided_rules, submanifold_rules


@dataclass(frozen=True)
class SparseTensor:
    """Features of the occupied cells of `samples` grids."""

    features: Tensor  # (N, C)
    keys: Tensor  # (N,) int64 cell keys (see `rules`), ascending
    shape: Triple  # grid extents z, y, x
    samples: int
    rules: dict[str, Rules] = field(default_factory=dict)  # submanifold rules of this set of cells, once made

    def with_features(self, features: Tensor) -> "SparseTensor":
        """Return the same cells with other features (N, C')."""
        return replace(self, features=features)

    def dense(self) -> Tensor:
        """Return (B, C, D, H, W) with zeros where no voxel is."""
        depth, height, width = self.shape
        sample, z, y, x = cells_of(self.keys, self.shape).unbind(1)
        flat = ((sample * depth + z) * height + y) * width + x
        rows = self.features.new_zeros(self.samples * depth * height * width, self.features.shape[1])
        rows = rows.index_copy(0, flat, self.features)
        return rows.view(self.samples, depth, height, width, -1).permute(0, 4, 1, 2, 3)

    def birds_eye(self) -> Tensor:
        """Return (B, D*C, H, W), the layers stacked as channels, in channels-last memory."""
        depth, height, width = self.shape
        sample, z, y, x = cells_of(self.keys, self.shape).unbind(1)
        flat = ((sample * height + y) * width + x) * depth + z
        rows = self.features.new_zeros(self.samples * height * width * depth, self.features.shape[1])
        rows = rows.index_copy(0, flat, self.features)
        return rows.view(self.samples, height, width, -1).permute(0, 3, 1, 2)


def sparse_convolution(features: Tensor, weight: Tensor, rules: Rules) -> Tensor:
    """Return (targets, C_out): target t gets the sum over its pairs (s, t, k) of features[s] @ weight[k].

    features: (sources, C_in); weight: (K, C_in, C_out). Differentiable in both; always in the features' own precision.
    """
    with torch.autocast(features.device.type, enabled=False):
        return _SparseConvolution.apply(features, weight.to(features.dtype), rules)


class _SparseConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, rules: Rules) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.rules = rules
        products = _scratch("products", len(rules.source), weight.shape[2], features)
        parts = zip(rules.source.split(rules.counts), products.split(rules.counts), weight, strict=True)
        for source, product, kernel in parts:
            torch.mm(_gathered(features, source, "sent"), kernel, out=product)
        return _sum(products, rules.by_target)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, None]:
        features, weight = ctx.saved_tensors
        rules: Rules = ctx.rules
        gradient = gradients[0].contiguous()
        wants_features = ctx.needs_input_grad[0]
        grad_weight = torch.empty_like(weight)
        products = _scratch("products", len(rules.source), weight.shape[1], features)
        slots = products.split(rules.counts)
        if rules.by_source is None:  # grouped by the mirrored pairs' targets, which are these pairs' sources
            slots = slots[::-1]
        pairs = zip(rules.source.split(rules.counts), rules.target.split(rules.counts), slots, strict=True)
        for k, (source, target, product) in enumerate(pairs):
            arrived = _gathered(gradient, target, "arrived")
            torch.mm(_gathered(features, source, "sent").t(), arrived, out=grad_weight[k])
            if wants_features:
                torch.mm(arrived, weight[k].t(), out=product)
        if not wants_features:
            return None, grad_weight, None
        return _sum(products, rules.by_source or rules.by_target), grad_weight, None


_buffers = threading.local()


def _scratch(name: str, rows: int, columns: int, like: Tensor) -> Tensor:
    """Return an uninitialised (rows, columns) view of a buffer that this thread's next call of that name reuses.

    Fresh memory of this size would cost the CPU more in page faults than the arithmetic on it.
    """
    if like.device.type != "cpu":
        return like.new_empty(rows, columns)
    buffer = getattr(_buffers, name, None)
    if buffer is None or buffer.dtype != like.dtype or buffer.numel() < rows * columns:
        with torch.inference_mode(False):  # else training could not reuse it
            buffer = like.new_empty(rows * columns * 5 // 4)
        setattr(_buffers, name, buffer)
    return buffer[: rows * columns].view(rows, columns)


def _gathered(rows: Tensor, index: Tensor, name: str) -> Tensor:
    """Return rows[index] for one kernel offset: few enough rows to stay in the cache for the product that follows."""
    return torch.index_select(rows, 0, index, out=_scratch(name, len(index), rows.shape[1], rows))


def _sum(rows: Tensor, groups: Groups) -> Tensor:
    if not len(rows):
        return rows.new_zeros(len(groups.begins), rows.shape[1])
    return F.embedding_bag(groups.order, rows, groups.begins, mode="sum")


class SubmanifoldConv3d(nn.Module):
    """3x3x3 convolution whose output lives on the input's voxels."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(_initial(27, in_channels, out_channels))

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Return the convolution on the same cells; the rules are made once per set of cells."""
        if "submanifold" not in x.rules:
            x.rules["submanifold"] = submanifold_rules(x.keys, x.shape)
        return x.with_features(sparse_convolution(x.features, self.weight, x.rules["submanifold"]))


class StridedConv3d(nn.Module):
    """Convolution onto a coarser grid: an output wherever a window holds an input voxel. Triples are z, y, x."""

    def __init__(self, in_channels: int, out_channels: int, kernel: Triple, stride: Triple, padding: Triple) -> None:
        super().__init__()
        self.kernel, self.stride, self.padding = kernel, stride, padding
        self.weight = nn.Parameter(_initial(math.prod(kernel), in_channels, out_channels))

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Return the convolution on the coarser grid."""
        rules, keys, shape = strided_rules(x.keys, x.shape, self.kernel, self.stride, self.padding, x.samples)
        return SparseTensor(sparse_convolution(x.features, self.weight, rules), keys, shape, x.samples)


def _initial(offsets: int, in_channels: int, out_channels: int) -> Tensor:
    active = offsets / 3  # about a third of a LiDAR voxel's neighbours are occupied
    return torch.randn(offsets, in_channels, out_channels) * math.sqrt(2 / (in_channels * active))
