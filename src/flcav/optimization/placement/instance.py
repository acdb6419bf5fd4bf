"""Instances of budgeted maximum coverage: candidates, the errors that they cover, and their costs.

A candidate is a sensor on a pole. Sensors are in the order of their ranges, so that each covers what the preceding ones
cover from the same pole; a pole carries at most one.

Weights and costs are decimals as users write them. Statements about their sums are exact, in integer multiples of
`UNIT`; floats only guide the search.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Context, Decimal
from fractions import Fraction
from functools import cached_property
from math import floor, gcd

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from flcav.geometry.arrays import Array

TIE = 1e-9  # relative difference below which the search takes covered weights and costs for equal
DECIMALS = 25  # of a float from 1e-9 on, which has 17 digits at most
UNIT = Fraction(1, 10**DECIMALS)
EXACT = Context(prec=60)
Units = NDArray[np.object_]  # of int: whole numbers of `UNIT`


def in_units(values: ArrayLike) -> Units:
    """Return the decimals by which floats (0, or at least 1e-9) are written, as integer multiples of `UNIT`."""
    distinct, which = np.unique(np.asarray(values, np.float64), return_inverse=True)
    whole = [int(Decimal(repr(value)).scaleb(DECIMALS, EXACT)) for value in distinct.tolist()]
    return np.array(whole, dtype=object)[which]


def limit_in_units(limit: float) -> int:
    """Return the greatest integer multiple of `UNIT` that does not exceed `limit` as a decimal."""
    return floor(Fraction(repr(float(limit))) / UNIT)


def as_float(units: int) -> float:
    """Return the float nearest to an integer multiple of `UNIT`."""
    return units / 10**DECIMALS


def common_unit(units: Iterable[int]) -> int:
    """Return the greatest common divisor: any two sums of the numbers differ by a multiple of it."""
    return gcd(*units) or 1


@dataclass(frozen=True)
class CoverageInstance:
    """Budgeted maximum coverage over N candidates and K groups of errors; a group is covered by the same candidates.

    Candidate k is the sensor k % `sensors` on the pole k // `sensors`.
    """

    covers: csr_array  # (N, K) 1.0 where a candidate covers a group
    weight: Array  # (K,) of a group's errors together
    cost: Array  # (N,)
    price: Units  # (N,) the same, exactly
    sensors: int = 1  # kinds of sensors, in the order of their ranges
    group: NDArray[np.int64] | None = None  # (E,) of each error, -1: nobody covers it; None: each error is a group
    summed: Units | None = None  # (K,) the weight, exactly; None: `weight` is as it was given

    @cached_property
    def worth(self) -> Units:
        """Return the exact weight (K,) of each group, in `UNIT`s."""
        return in_units(self.weight) if self.summed is None else self.summed

    def cost_of(self, chosen: Iterable[int]) -> int:
        """Return the exact cost of the `chosen` candidates, in `UNIT`s."""
        return sum(self.price[[*chosen]].tolist())

    def worth_of(self, chosen: ArrayLike) -> int:
        """Return the exact weight that the `chosen` candidates cover together, in `UNIT`s."""
        return sum(self.worth[reach(self.covers, chosen)].tolist())

    def covered_by(self, candidate: int) -> NDArray[np.int32]:
        """Return the indices of the groups that a candidate covers."""
        return np.asarray(
            self.covers.indices[self.covers.indptr[candidate] : self.covers.indptr[candidate + 1]], np.int32
        )

    def value(self, chosen: ArrayLike) -> float:
        """Return the weight that the `chosen` candidates cover together."""
        return float(self.weight[reach(self.covers, chosen)].sum())


def reach(covers: csr_array, chosen: ArrayLike) -> NDArray[np.bool_]:
    """Return the mask (K,) of the columns of `covers` (N, K) that the `chosen` rows cover together."""
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
        near = np.flatnonzero(squared <= ranges[-1] ** 2 + _doubt(site, ranges[-1]))
        squared, near = squared[near], order[start + near]
        found += [np.sort(near[_within(squared, errors[near], site, range_m)]) for range_m in ranges.tolist()]
    ends = np.cumsum([0, *(len(each) for each in found)])
    shape = (len(poles) * len(ranges), len(errors))
    return csr_array((np.ones(ends[-1]), np.concatenate(found).astype(np.int32), ends.astype(np.int32)), shape=shape)


def _within(squared: Array, errors: Array, site: Array, range_m: float) -> NDArray[np.bool_]:
    """Return the mask (E,) of errors within the range, from distances `squared` (E,) [m^2]; close cases are exact."""
    inside = squared <= range_m**2
    for near in np.flatnonzero(np.abs(squared - range_m**2) <= _doubt(site, range_m)).tolist():
        axes = zip(errors[near].tolist(), site.tolist(), strict=True)
        apart = (Fraction(repr(one)) - Fraction(repr(other)) for one, other in axes)
        inside[near] = sum(each**2 for each in apart) <= Fraction(repr(range_m)) ** 2
    return inside


def _doubt(site: Array, range_m: float) -> float:
    """Return the largest rounding error of a squared distance near the range from a pole [m^2]."""
    return 1e-14 * range_m * (range_m + float(np.abs(site).max()))


def merge_errors(
    covers: csr_array, weights: Array, cost: Array, sensors: int, price: Units, worth: Units
) -> CoverageInstance:
    """Return the instance in which errors that the same candidates cover are merged into one group.

    `covers` (N, E), `weights` (E,) and `cost` (N,) are of single errors; `worth` (E,) and `price` (N,) are the exact
    weights and costs. Errors that no candidate covers are left out. Groups are in the lexical order of their columns.
    """
    candidates, count = covers.shape  # pyright: ignore[reportGeneralTypeIssues]
    width = -(-candidates // 8)
    by = np.repeat(np.arange(candidates), np.diff(covers.indptr))
    # Columns as packed bits: equal columns are equal byte strings, which `np.unique` sorts and merges.
    error = covers.indices.astype(np.int64)
    bits = np.zeros(count * width, np.uint8)
    np.bitwise_or.at(bits, error * width + by // 8, (128 >> by % 8).astype(np.uint8))
    seen = np.flatnonzero(np.bincount(error, minlength=count))
    columns = np.ascontiguousarray(bits.reshape(count, width)[seen]).view(f"V{width}").ravel()
    _, first, group = np.unique(columns, return_index=True, return_inverse=True)
    summed = np.zeros(len(first), dtype=object)
    np.add.at(summed, group.ravel(), worth[seen])
    kept = csr_array(covers.tocsc()[:, seen[first]])
    kept.sort_indices()
    group_of = np.full(count, -1, np.int64)
    group_of[seen] = group.ravel()
    total = np.array([as_float(each) for each in summed.tolist()])
    return CoverageInstance(kept, total, cost, price, sensors, group_of, summed)
