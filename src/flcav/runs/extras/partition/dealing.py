"""Non-IID partitions of samples among vehicles: by class, by place, by amount, and by a Dirichlet draw of each class.

By class: shards of the samples in the order of their classes (McMahan et al., AISTATS 2017). By amount: shares of
all samples drawn from a Dirichlet distribution, equal in their classes but for chance (Li et al., "Federated learning
on non-IID data silos", ICDE 2022). Dirichlet: such shares are drawn for each class (Hsu et al., "Measuring the effects
of non-identical data distribution for federated visual classification", 2019).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array, Ints


def deal_by_class(labels: NDArray, vehicles: int, shards: int, rng: np.random.Generator) -> Ints:
    """Return the vehicle (N,) of each sample: each is dealt `shards` of the equal parts of samples sorted by label.

    labels: (N,) class of each sample, of any type that can be sorted.
    """
    order = np.lexsort((rng.permutation(len(labels)), labels))
    owners = rng.permutation(vehicles * shards) % vehicles
    return _assign(np.array_split(order, vehicles * shards), owners.tolist(), len(labels))


def deal_by_place(positions: Array, vehicles: int) -> Ints:
    """Return the vehicle (N,) of each sample: each has one area, with as equal a number of samples as can be.

    positions: (N, 2) [m]. Areas are halved across their longer side until there is one for each vehicle.
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
    """Return the vehicle (N,) of each of `count` samples: shares of the vehicles are drawn from Dir(alpha)."""
    return _assign(_cut(rng.permutation(count), vehicles, alpha, rng), range(vehicles), count)


def deal_by_dirichlet(labels: NDArray, vehicles: int, alpha: float, rng: np.random.Generator) -> Ints:
    """Return the vehicle (N,) of each sample: of each class the vehicles' shares are drawn from Dir(alpha).

    labels: (N,) class of each sample.
    """
    owner = np.zeros(len(labels), np.int64)
    for label in np.unique(labels):
        own = np.flatnonzero(labels == label)
        owner[own] = deal_by_amount(len(own), vehicles, alpha, rng)
    return owner


def give_each_one(owner: Ints, vehicles: int) -> Ints:
    """Return the vehicle (N,) of each sample, where a vehicle without any has the last one of whoever has most.

    Of fewer samples than vehicles the last vehicles have none.
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
    for part, own in zip(parts, owners, strict=True):
        owner[part] = own
    return owner
