"""Non-IID partitions of samples among vehicles: by class, by place, by amount, and by a Dirichlet draw per class.

By class: shards of the samples in the order of their classes (McMahan et al., AISTATS 2017). By amount: shares of
all samples drawn from a Dirichlet distribution, equal in their classes but for chance (Li et al., "Federated learning
on non-IID data silos", ICDE 2022). Dirichlet: such shares are drawn per class (Hsu et al., "Measuring the effects of
non-identical data distribution for federated visual classification", 2019).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array, Ints


def deal_by_class(labels: NDArray, vehicles: int, shards: int, rng: np.random.Generator) -> Ints:
    """Return the vehicles of the samples (N,): a vehicle gets `shards` of the equal parts of samples sorted by label.

    `labels`: (N,) classes of the samples, of any type that can be sorted. Samples of a class are in random order.
    """
    order = np.lexsort((rng.permutation(len(labels)), labels))
    owners = rng.permutation(vehicles * shards) % vehicles  # (vehicles * shards,): a vehicle owns exactly `shards`
    return _assign(np.array_split(order, vehicles * shards), owners.tolist(), len(labels))


def deal_by_place(positions: Array, vehicles: int) -> Ints:
    """Return the vehicles of the samples (N,): a vehicle gets one area, with as equal a number of samples as possible.

    `positions`: (N, 2) world frame [m]. Areas are halved across their longer side until there is one per vehicle.
    """

    def halve(places: Ints, count: int) -> list[Ints]:
        if count == 1:
            return [places]
        near = positions[places]
        axis = int(np.argmax(near.max(axis=0) - near.min(axis=0))) if len(near) else 0
        order = places[np.argsort(near[:, axis], kind="stable")]
        cut = round(len(order) * (count // 2) / count)
        return halve(order[:cut], count // 2) + halve(order[cut:], count - count // 2)

    return _assign(halve(np.arange(len(positions)), vehicles), range(vehicles), len(positions))


def deal_by_amount(count: int, vehicles: int, alpha: float, rng: np.random.Generator) -> Ints:
    """Return the vehicles of `count` samples (N,): the vehicles' shares are drawn from Dir(alpha)."""
    return _assign(_cut(rng.permutation(count), vehicles, alpha, rng), range(vehicles), count)


def deal_by_dirichlet(labels: NDArray, vehicles: int, alpha: float, rng: np.random.Generator) -> Ints:
    """Return the vehicles of the samples (N,): the vehicles' shares of a class are drawn from Dir(alpha), per class.

    `labels`: (N,) classes of the samples.
    """
    owner = np.zeros(len(labels), np.int64)
    for label in np.unique(labels):
        rows = np.flatnonzero(labels == label)
        owner[rows] = deal_by_amount(len(rows), vehicles, alpha, rng)
    return owner


def give_each_one(owner: Ints, vehicles: int) -> Ints:
    """Return the vehicles of the samples (N,), after giving a vehicle without any the last sample of the one with most.

    If there are fewer samples than vehicles, the last vehicles have none.
    """
    owner = owner.copy()
    for vehicle in range(min(vehicles, len(owner))):
        counts = np.bincount(owner, minlength=vehicles)
        if counts[vehicle] == 0:
            owner[np.flatnonzero(owner == counts.argmax())[-1]] = vehicle
    return owner


def _cut(order: Ints, vehicles: int, alpha: float, rng: np.random.Generator) -> list[Ints]:
    ends = np.round(np.cumsum(rng.dirichlet([alpha] * vehicles)) * len(order)).astype(int)
    return np.split(order, ends[:-1])


def _assign(parts: Sequence[Ints], owners: Sequence[int], count: int) -> Ints:
    owner = np.zeros(count, np.int64)
    for part, assigned in zip(parts, owners, strict=True):
        owner[part] = assigned
    return owner
