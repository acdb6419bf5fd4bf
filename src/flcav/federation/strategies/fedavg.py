"""Federated averaging (McMahan et al., AISTATS 2017, algorithm 1)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.federation.trainable import Update, Weights, learned_names

NO_MEAN = "clients cannot be averaged by shares of {}: they must be 0 or more, not all 0"
Floats = NDArray[np.float64]

BLOCK = 1 << 15  # numbers added at a time, so that their products stay in the cache


class NoShares(ValueError):
    """All shares of a mean are 0."""


def round_mean(mean: Floats, low: NDArray[np.number], high: NDArray[np.number]) -> NDArray[np.number]:
    """Return a mean or median of integers, rounded to the nearest integer of their dtype.

    `low` and `high` are the smallest and the largest of the integers. The result is clipped to them, so that a value
    that all clients share stays exact even beyond the precision of float64.
    """
    with np.errstate(invalid="ignore"):  # values outside the dtype are replaced by the ends
        inside = np.rint(mean).astype(low.dtype)
    return np.where(mean >= high, high, np.where(mean <= low, low, inside))


class RunningMean:
    """Running weighted mean of arrays by name, sum_i share_i w_i / sum_i share_i, over clients added one by one.

    It takes the memory of a single client's arrays in float64. Means of integers are rounded, see
    `round_mean`.
    """

    def __init__(self) -> None:
        self._form: dict[str, tuple[tuple[int, ...], np.dtype]] = {}  # of the first client
        self._ends: dict[str, tuple[NDArray[np.number], NDArray[np.number]]] = {}  # smallest and largest integers
        self._sums: dict[str, NDArray[np.float64]] = {}
        self._shares: list[float] = []
        self._products = np.empty(BLOCK)

    def add(self, weights: Weights, share: float) -> None:
        """Add a client.

        Raises ValueError where its share is negative or not finite, or its arrays differ from the first one's in name,
        order or shape.
        """
        if not (np.isfinite(share) and share >= 0):
            raise ValueError(NO_MEAN.format([share]))
        if not self._shares:
            self._form = {name: (array.shape, array.dtype) for name, array in weights.items()}
            self._sums = {name: np.zeros(array.shape) for name, array in weights.items()}
        elif [(name, a.shape) for name, a in weights.items()] != [(name, form[0]) for name, form in self._form.items()]:
            raise ValueError("clients sent arrays of different names or shapes: they train different networks")
        self._shares.append(share)
        for name, array in weights.items() if share else ():
            if not np.issubdtype(array.dtype, np.floating):
                low, high = self._ends.get(name, (array, array))
                self._ends[name] = np.minimum(low, array), np.maximum(high, array)
        # block by block, so that no second array of the network's size is needed
        for name, total in self._sums.items():
            values, sums = weights[name].reshape(-1), total.reshape(-1)
            for start in range(0, values.size, BLOCK):
                part = values[start : start + BLOCK]
                sums[start : start + BLOCK] += np.multiply(
                    part, share, out=self._products[: part.size], dtype=np.float64
                )

    def mean(self) -> dict[str, NDArray[np.number]]:
        """Return the mean, in the first client's dtypes; raises `NoShares` where all shares are 0."""
        whole = float(np.sum(self._shares))
        if not whole:
            raise NoShares(NO_MEAN.format(self._shares))
        means = {name: np.asarray(total / whole) for name, total in self._sums.items()}
        return {
            name: round_mean(means[name], *self._ends[name]) if name in self._ends else means[name].astype(dtype)
            for name, (_, dtype) in self._form.items()
        }


def average(weights: Sequence[Weights], shares: Sequence[float]) -> dict[str, NDArray[np.number]]:
    """Return the weighted mean of the clients' arrays, see `RunningMean`; `shares` has one entry per client.

    Raises ValueError where a share is negative or not finite, `NoShares` where all are 0, ValueError where the clients'
    arrays differ in name, order or shape.
    """
    mean = RunningMean()
    for each, share in zip(weights, shares, strict=True):
        mean.add(each, share)
    return mean.mean()


def average_inversely(start: Weights, updates: Mapping[str, Update], weights: Mapping[str, float]) -> Weights:
    """Return start + sum_i weights_i (w_i - start) for learned arrays, and the mean of the updates for all others.

    With weights_i = share_i / probability_i it is the unbiased (Horvitz-Thompson) estimate of the mean of all clients.
    """
    names = learned_names(start)
    moved: dict[str, Any] = {name: np.zeros(start[name].shape) for name in names}
    for client, update in updates.items():
        for name in names:
            moved[name] += weights[client] * (update.weights[name].astype(np.float64) - start[name])
    mean = average([update.weights for update in updates.values()], [*weights.values()])
    return mean | {name: (start[name] + array).astype(start[name].dtype) for name, array in moved.items()}


@dataclass(frozen=True)
class FedAvg:
    """Federated averaging: the mean of the clients' weights, weighted by their numbers of samples."""

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the mean of the updates' weights, weighted by samples; raises ValueError as `average` does."""
        return average([update.weights for update in updates], [update.samples for update in updates])

    def weigh(self, update: Update) -> float:
        """Return the update's number of samples."""
        return float(update.samples)
