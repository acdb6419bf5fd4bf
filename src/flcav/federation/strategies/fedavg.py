"""Federated averaging (McMahan et al., AISTATS 2017, algorithm 1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.federation.trainable import Update, Weights


def average(weights: Sequence[Weights], shares: Sequence[float]) -> dict[str, np.ndarray]:
    """Return the weighted mean of the clients' arrays by name: sum_i share_i w_i / sum_i share_i, in their own type.

    `shares` has one entry per client. Floating arrays are summed in float64; of any other array the first client's is
    returned. Raises ValueError where a share is negative or not finite, or all are 0, and where the clients' arrays
    differ in name, order or shape.
    """
    first = weights[0]
    for other in weights[1:]:
        if [(n, a.shape) for n, a in first.items()] != [(n, a.shape) for n, a in other.items()]:
            raise ValueError("clients sent arrays of different names or shapes: they train different networks")
    share = np.asarray(shares, dtype=np.float64)
    if not (np.isfinite(share).all() and (share >= 0).all() and share.any()):
        raise ValueError(f"clients cannot be averaged by shares of {share.tolist()}: they must be 0 or more, not all 0")
    share = share / share.sum()

    def combined(name: str) -> np.ndarray:
        array = first[name]
        if not np.issubdtype(array.dtype, np.floating):
            return array
        total = sum(s * w[name].astype(np.float64) for s, w in zip(share, weights, strict=True))
        return np.asarray(total).astype(array.dtype)

    return {name: combined(name) for name in first}


@dataclass(frozen=True)
class FedAvg:
    """Federated averaging: the mean of the clients' weights, weighted by their numbers of samples."""

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the mean of the updates' weights, weighted by samples; raises ValueError as `average` does."""
        return average([update.weights for update in updates], [update.samples for update in updates])
