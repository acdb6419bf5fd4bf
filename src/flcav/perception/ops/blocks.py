"""Blocked gather-multiply-scatter kernels of sparse convolution on a CPU, compiled: forward pass and gradients.

The pairs of a rulebook are worked through in blocks. The products of a block stay in the processor's cache; those of
all pairs at once would go through main memory. Each matrix product is smaller than those that BLAS spreads over
threads.
"""

import numpy as np
from numpy.typing import NDArray

from flcav.machine.compiled import compiled

Array = NDArray[np.floating]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]

BLOCK = 1 << 18  # most multiplications in the matrix product of a block
LONGEST = 1024  # most pairs in a block


@compiled
def convolve(features: Array, weight: Array, source: Int32s, target: Int32s, begins: Int64s, out: Array) -> None:
    """Sparse convolution, forward pass: add features[s] @ weight[k] to out[t] for every pair (s, t) of kernel offset k.

    features (N, C), weight (K, C, C'), out (M, C'), changed in place. source and target (P,) are the rows s and t of
    the pairs; those of offset k are numbers begins[k] to begins[k + 1], begins (K + 1,). No target occurs twice in an
    offset.
    """
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
def weight_gradient(
    features: Array, gradient: Array, source: Int32s, target: Int32s, begins: Int64s, out: Array
) -> None:
    """Gradient of the weights: add features[s]^T gradient[t] to out[k] for every pair (s, t) of kernel offset k.

    features (N, C), gradient of the output (M, C'), out (K, C, C'), changed in place; pairs as in `convolve`.
    """
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
def gradients(
    features: Array,
    gradient: Array,
    turned: Array,
    source: Int32s,
    target: Int32s,
    begins: Int64s,
    to_features: Array,
    to_weight: Array,
) -> None:
    """Gradients of weights and input features, in one pass over the pairs.

    For every pair (s, t) of kernel offset k, features[s]^T gradient[t] is added to to_weight[k] (K, C, C'), and
    gradient[t] @ turned[k] to to_features[s] (N, C), both in place. turned (K, C', C): the weight of each offset,
    transposed. The rest is as in `convolve`.
    """
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
def _gather(rows: Array, index: Int32s, first: int, out: Array) -> None:
    for pair in range(out.shape[0]):
        row = np.uint64(index[first + pair])
        for column in range(out.shape[1]):
            out[pair, column] = rows[row, column]


@compiled
def _scatter(rows: Array, index: Int32s, first: int, out: Array) -> None:
    for pair in range(rows.shape[0]):
        row = np.uint64(index[first + pair])
        for column in range(rows.shape[1]):
            out[row, column] += rows[pair, column]
