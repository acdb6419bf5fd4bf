"""Submanifold and strided sparse 3D convolution: gather, one matrix product per kernel offset, sum by output voxel.

On a CPU compiled kernels process the pairs of a rulebook in blocks, so that the products of a block stay in the
processor's cache instead of going through main memory. Each product is smaller than those that BLAS spreads over
threads. Elsewhere the sum by output voxel is an `embedding_bag`, which reads each product once, in the order of the
outputs. The backward pass is written by hand and keeps only the input features and the weight.
Convolutions: Graham et al., "3D Semantic Segmentation with Submanifold Sparse Convolutional Networks", CVPR 2018.
"""

import contextlib
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from flcav.arrays import Ints, Ints32
from flcav.machine.compiled import compiled
from flcav.perception.ops.rulebook import (
    Groups,
    Rulebook,
    Triple,
    build_strided_rulebook,
    build_submanifold_rulebook,
    decode_keys,
)

Floats = NDArray[np.floating]
Pairs = tuple[Ints32, Ints32, Ints]  # source and target (P,), and where each kernel offset's pairs begin (K + 1,)


@dataclass(frozen=True)
class SparseTensor:
    """Sparse tensor: features of the occupied voxels of a batch of grids."""

    features: Tensor  # (N, C)
    keys: Tensor  # (N,) int64 keys of the cells, ascending; see `flcav.perception.ops.rulebook`
    shape: Triple  # grid extents z, y, x
    samples: int  # grids in the batch, B
    rulebooks: dict[str, Rulebook] = field(default_factory=dict)  # cache of the submanifold rulebook of these voxels

    def with_features(self, features: Tensor) -> "SparseTensor":
        """Return the same voxels with other features (N, C')."""
        return replace(self, features=features)

    def dense(self) -> Tensor:
        """Return the dense tensor (B, C, D, H, W), zero where no voxel is occupied."""
        depth, height, width = self.shape
        sample, z, y, x = decode_keys(self.keys, self.shape).unbind(1)
        flat = ((sample * depth + z) * height + y) * width + x
        rows = self.features.new_zeros(self.samples * depth * height * width, self.features.shape[1])
        rows = rows.index_copy(0, flat, self.features)
        return rows.view(self.samples, depth, height, width, -1).permute(0, 4, 1, 2, 3)

    def birds_eye(self) -> Tensor:
        """Return the bird's-eye-view map (B, D*C, H, W), height layers stacked as channels, in channels-last memory."""
        depth, height, width = self.shape
        sample, z, y, x = decode_keys(self.keys, self.shape).unbind(1)
        flat = ((sample * height + y) * width + x) * depth + z
        rows = self.features.new_zeros(self.samples * height * width * depth, self.features.shape[1])
        rows = rows.index_copy(0, flat, self.features)
        return rows.view(self.samples, height, width, -1).permute(0, 3, 1, 2)


def sparse_convolution(features: Tensor, weight: Tensor, rules: Rulebook) -> Tensor:
    """Return the sparse convolution (M, C'): row t is the sum of features[s] @ weight[k] over the pairs (s, t, k).

    `features` is (N, C), `weight` (K, C, C'); differentiable in both. It is computed in the precision of the features,
    and on other devices than a CPU in that of autocast, where autocast is on.
    """
    kind = features.device.type
    if rules.by_target is not None and torch.is_autocast_enabled(kind):
        features = features.to(torch.get_autocast_dtype(kind))
    with torch.autocast(kind, enabled=False):
        return _SparseConvolution.apply(features, weight.to(features.dtype), rules)


_second: ThreadPoolExecutor | None = None  # with a single thread


@contextlib.contextmanager
def second_core() -> Iterator[None]:
    """Compute gradients of weights in a second thread within the context, parallel to those of features; same bits."""
    global _second
    with ThreadPoolExecutor(1) as _second:
        try:
            yield
        finally:
            _second = None


class _SparseConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, rules: Rulebook) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.rules, ctx.sources = rules, len(features)
        if rules.by_target is not None:
            return _grouped(features, weight, rules, rules.by_target)
        out = features.new_zeros(rules.targets, weight.shape[2])
        arrays = (features.detach().contiguous().numpy(), weight.detach().contiguous().numpy())
        convolve(*arrays, _pairs(rules), out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, None]:
        features, weight = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        wants_features = ctx.needs_input_grad[0]
        if ctx.rules.by_target is not None:
            return *_grouped_gradients(features, weight, gradient, ctx.rules, wants_features), None
        grad_weight = torch.zeros_like(weight, memory_format=torch.contiguous_format)
        arrays = (features.detach().contiguous().numpy(), gradient.numpy())
        if not wants_features:
            weight_gradient(*arrays, _pairs(ctx.rules), grad_weight.numpy())
            return None, grad_weight, None
        grad_features = torch.zeros_like(features, memory_format=torch.contiguous_format)
        turned = weight.detach().transpose(1, 2).contiguous().numpy()
        pairs = _pairs(ctx.rules)
        if _second is None:
            convolution_gradients(*arrays, turned, pairs, grad_features.numpy(), grad_weight.numpy())
        else:
            weights_done = _second.submit(weight_gradient, *arrays, pairs, grad_weight.numpy())
            source, target, begins = pairs
            convolve(arrays[1], turned, (target, source, begins), grad_features.numpy())
            weights_done.result()
        return grad_features, grad_weight, None


def _pairs(rules: Rulebook) -> Pairs:
    """Return source (P,), target (P,), and (K + 1,) where the pairs of each offset begin, and the last ones end."""
    return rules.source.numpy(), rules.target.numpy(), np.cumsum((0, *rules.counts), dtype=np.int64)


def _grouped(features: Tensor, weight: Tensor, rules: Rulebook, by_target: Groups) -> Tensor:
    products = [
        features[source] @ kernel for source, kernel in zip(rules.source.split(rules.counts), weight, strict=True)
    ]
    return _sum(torch.cat(products), by_target)


def _grouped_gradients(
    features: Tensor, weight: Tensor, gradient: Tensor, rules: Rulebook, wants_features: bool
) -> tuple[Tensor | None, Tensor]:
    grad_weight = torch.empty_like(weight)
    products = []
    pairs = zip(rules.source.split(rules.counts), rules.target.split(rules.counts), strict=True)
    for k, (source, target) in enumerate(pairs):
        arrived = gradient[target]
        torch.mm(features[source].t(), arrived, out=grad_weight[k])
        if wants_features:
            products.append(arrived @ weight[k].t())
    if not wants_features:
        return None, grad_weight
    if rules.by_source is None:  # submanifold: the mirrored offsets' pairs have these sources as their targets
        return _sum(torch.cat(products[::-1]), cast(Groups, rules.by_target)), grad_weight
    return _sum(torch.cat(products), rules.by_source), grad_weight


def _sum(rows: Tensor, groups: Groups) -> Tensor:
    if not len(rows):
        return rows.new_zeros(len(groups.begins), rows.shape[1])
    return F.embedding_bag(groups.order, rows, groups.begins, mode="sum")


class SubmanifoldConv3d(nn.Module):
    """Submanifold 3x3x3 convolution: the output voxels are the input voxels."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(_initial(27, in_channels, out_channels))

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Return the convolution on the same voxels; their rulebook is built once and cached."""
        if "submanifold" not in x.rulebooks:
            x.rulebooks["submanifold"] = build_submanifold_rulebook(x.keys, x.shape)
        return x.with_features(sparse_convolution(x.features, self.weight, x.rulebooks["submanifold"]))


class StridedConv3d(nn.Module):
    """Strided sparse convolution onto a coarser grid: an output voxel for every window with an input voxel.

    kernel, stride, padding: along z, y, x.
    """

    def __init__(self, in_channels: int, out_channels: int, kernel: Triple, stride: Triple, padding: Triple) -> None:
        super().__init__()
        self.kernel, self.stride, self.padding = kernel, stride, padding
        self.weight = nn.Parameter(_initial(math.prod(kernel), in_channels, out_channels))

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Return the convolution as a sparse tensor of the coarser grid."""
        rules, keys, shape = build_strided_rulebook(x.keys, x.shape, self.kernel, self.stride, self.padding, x.samples)
        return SparseTensor(sparse_convolution(x.features, self.weight, rules), keys, shape, x.samples)


def _initial(offsets: int, in_channels: int, out_channels: int) -> Tensor:
    active = offsets / 3  # He initialisation: about a third of the neighbours of a LiDAR voxel are occupied
    return torch.randn(offsets, in_channels, out_channels) * math.sqrt(2 / (in_channels * active))


BLOCK = 1 << 18  # most multiplications in the matrix product of a block
LONGEST = 1024  # most pairs in a block


@compiled
def convolve(features: Floats, weight: Floats, pairs: Pairs, out: Floats) -> None:
    """Sparse convolution, forward pass: add features[s] @ weight[k] to out[t] for every pair (s, t) of kernel offset k.

    features (N, C), weight (K, C, C'), out (M, C'), changed in place. pairs: source and target (P,), the rows s
    and t, and begins (K + 1,): those of offset k are numbers begins[k] to begins[k + 1]. No target occurs twice in an
    offset.
    """
    source, target, begins = pairs
    block = min(LONGEST, max(1, BLOCK // (weight.shape[1] * weight.shape[2])))
    sent = np.empty((block, weight.shape[1]), dtype=features.dtype)
    product = np.empty((block, weight.shape[2]), dtype=features.dtype)
    for k in range(len(begins) - 1):
        for first in range(begins[k], begins[k + 1], block):
            n = min(block, begins[k + 1] - first)
            _gather(features, source, first, sent[:n])
            np.dot(sent[:n], weight[k], product[:n])
            _scatter(product[:n], target, first, out)


@compiled
def weight_gradient(features: Floats, gradient: Floats, pairs: Pairs, out: Floats) -> None:
    """Gradient of the weights: add features[s]^T gradient[t] to out[k] for every pair (s, t) of kernel offset k.

    features (N, C), gradient of the output (M, C'), out (K, C, C'), changed in place; pairs as in `convolve`.
    """
    source, target, begins = pairs
    block = min(LONGEST, max(1, BLOCK // (out.shape[1] * out.shape[2])))
    sent = np.empty((block, out.shape[1]), dtype=features.dtype)
    arrived = np.empty((block, out.shape[2]), dtype=features.dtype)
    part = np.empty((out.shape[1], out.shape[2]), dtype=features.dtype)
    for k in range(len(begins) - 1):
        for first in range(begins[k], begins[k + 1], block):
            n = min(block, begins[k + 1] - first)
            _gather(features, source, first, sent[:n])
            _gather(gradient, target, first, arrived[:n])
            np.dot(sent[:n].T, arrived[:n], part)
            out[k] += part


@compiled
def convolution_gradients(
    features: Floats, gradient: Floats, turned: Floats, pairs: Pairs, to_features: Floats, to_weight: Floats
) -> None:
    """Gradients of weights and input features, in one pass over the pairs.

    For every pair (s, t) of kernel offset k, features[s]^T gradient[t] is added to to_weight[k] (K, C, C'), and
    gradient[t] @ turned[k] to to_features[s] (N, C), both in place. turned (K, C', C): the weight of each offset,
    transposed. The rest is as in `convolve`.
    """
    source, target, begins = pairs
    block = min(LONGEST, max(1, BLOCK // (turned.shape[1] * turned.shape[2])))
    sent = np.empty((block, turned.shape[2]), dtype=features.dtype)
    arrived = np.empty((block, turned.shape[1]), dtype=features.dtype)
    product = np.empty_like(sent)
    part = np.empty((turned.shape[2], turned.shape[1]), dtype=features.dtype)
    for k in range(len(begins) - 1):
        for first in range(begins[k], begins[k + 1], block):
            n = min(block, begins[k + 1] - first)
            _gather(features, source, first, sent[:n])
            _gather(gradient, target, first, arrived[:n])
            np.dot(sent[:n].T, arrived[:n], part)
            to_weight[k] += part
            np.dot(arrived[:n], turned[k], product[:n])
            _scatter(product[:n], source, first, to_features)


@compiled
def _gather(rows: Floats, index: Ints32, first: int, out: Floats) -> None:
    for pair in range(out.shape[0]):
        row = np.uint64(index[first + pair])
        for column in range(out.shape[1]):
            out[pair, column] = rows[row, column]


@compiled
def _scatter(rows: Floats, index: Ints32, first: int, out: Floats) -> None:
    for pair in range(rows.shape[0]):
        row = np.uint64(index[first + pair])
        for column in range(rows.shape[1]):
            out[row, column] += rows[pair, column]
