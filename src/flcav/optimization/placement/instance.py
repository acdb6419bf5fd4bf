"""Instances of budgeted maximum coverage: which candidate covers what, what it costs.

A candidate is a sensor on a pole. Sensors are in the order of their ranges, so that each covers what those before it
cover from the same pole; a pole carries at most one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

Array = NDArray[np.float64]

TIE = 1e-9  # relative difference below which covered weights and costs are equal


@dataclass(frozen=True)
class CoverageInstance:
    """Budgeted maximum coverage over N candidates and K groups of errors that the same candidates cover.

    Candidate k is the sensor k % `sensors` on the pole k // `sensors`.
    """

    covers: csr_array  # (N, K) 1.0 where a candidate covers a group
    weight: Array  # (K,) of a group's errors together
    cost: Array  # (N,)
    sensors: int = 1  # kinds of sensors, in the order of their ranges
    group: NDArray[np.int64] | None = None  # (E,) of each error, -1: nobody covers it; None: each error is a group

    def covered_by(self, candidate: int) -> NDArray[np.int32]:
        """Return the numbers of the groups that a candidate covers."""
        return np.asarray(
            self.covers.indices[self.covers.indptr[candidate] : self.covers.indptr[candidate + 1]], np.int32
        )

    def value(self, chosen: ArrayLike) -> float:
        """Return the weight that the `chosen` candidates cover together."""
        return float(self.weight[reach(self.covers, chosen)].sum())


def reach(covers: csr_array, chosen: ArrayLike) -> NDArray[np.bool_]:
    """Return (K,) which columns of `covers` (N, K) the `chosen` rows cover together."""
    return np.bincount(covers[np.asarray(chosen, np.int64)].indices, minlength=covers.shape[1]) > 0  # pyright: ignore[reportOptionalSubscript]


def find_covered(errors: Array, poles: Array, ranges_m: ArrayLike) -> csr_array:
    """Return the sparse coverage matrix (P * S, E), 1.0 where an error is within the range of a candidate.

    `errors` (E, 3) and `poles` (P, 3) are in the world frame [m]; `ranges_m` (S,) ascend.
    """
    ranges = np.asarray(ranges_m, np.float64)
    order = np.argsort(errors[:, 0], kind="stable")
    places = errors[order]
    found: list[NDArray[np.int64]] = []
    margin = ranges[-1] * (1 + TIE) + TIE * np.abs(poles[:, 0])  # the slab of x that may hold covered errors
    first, last = (np.searchsorted(places[:, 0], poles[:, 0] + side * margin) for side in (-1, 1))
    for site, start, end in zip(poles, first.tolist(), last.tolist(), strict=True):
        squared = ((places[start:end] - site) ** 2).sum(axis=1)
        near = np.flatnonzero(squared <= ranges[-1] ** 2)
        squared, near = squared[near], order[start + near]
        found += [np.sort(near[squared <= range_m**2]) for range_m in ranges]
    ends = np.cumsum([0, *(len(each) for each in found)])
    shape = (len(poles) * len(ranges), len(errors))
    return csr_array((np.ones(ends[-1]), np.concatenate(found).astype(np.int32), ends.astype(np.int32)), shape=shape)


def merge_errors(covers: csr_array, weights: Array, cost: Array, sensors: int = 1) -> CoverageInstance:
    """Return the instance in which errors that the same candidates cover are one group.

    `covers` (N, E), `weights` (E,) and `cost` (N,) are of single errors. Errors that nobody covers are left out. Groups
    are in the lexical order of their columns.
    """
    candidates, count = covers.shape  # pyright: ignore[reportGeneralTypeIssues]
    width = -(-candidates // 8)
    by, error = np.repeat(np.arange(candidates), np.diff(covers.indptr)), covers.indices.astype(np.int64)
    bits = np.zeros(count * width, np.uint8)
    np.bitwise_or.at(bits, error * width + by // 8, (128 >> by % 8).astype(np.uint8))
    seen = np.flatnonzero(np.bincount(error, minlength=count))
    columns = np.ascontiguousarray(bits.reshape(count, width)[seen]).view(f"V{width}").ravel()
    _, first, group = np.unique(columns, return_index=True, return_inverse=True)
    total = np.bincount(group.ravel(), weights[seen]).astype(np.float64)
    kept = csr_array(covers.tocsc()[:, seen[first]])
    kept.sort_indices()
    group_of = np.full(count, -1, np.int64)
    group_of[seen] = group.ravel()
    return CoverageInstance(kept, total, cost, sensors, group_of)
