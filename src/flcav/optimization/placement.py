"""VRCSP, placement of roadside sensors on poles, as weighted maximum coverage of the registered perception errors.

A sensor at x covers an error at e where ||e - x|| <= range, in three dimensions. The greedy algorithm reaches at least
1 - 1/e (here Euler's number) of the optimum (Nemhauser, Wolsey and Fisher 1978); the exact method is a mixed-integer
program solved by HiGHS, with a proven upper bound. VRCSP: Wang et al., IEEE Network 37(3), 2023.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import Bounds, LinearConstraint, linprog, milp
from scipy.sparse import csr_array, eye_array, hstack, vstack

from flcav.config import InputError

Array = NDArray[np.float64]
Method = Literal["exact", "greedy"]

FARTHEST_M = 1e9  # largest coordinate and range
TIE = 1e-9  # relative difference below which covered weights are equal


@dataclass(frozen=True)
class Placement:
    """The chosen poles, the errors they cover, and a certificate of optimality."""

    chosen: tuple[int, ...]  # indices into the poles, ascending
    covered: int  # errors within range of a chosen pole
    covered_weight: float
    upper_bound: float  # proven: no choice of as many poles covers more weight
    optimal: bool  # whether `covered_weight` equals the bound


def coverage(errors: ArrayLike, poles: ArrayLike, range_m: float) -> NDArray[np.bool_]:
    """Return the coverage matrix (P, E): whether each of the `poles` (P, 3) is within `range_m` of each error (E, 3).

    Positions are in the world frame [m].
    """
    sites, places = np.asarray(poles, dtype=np.float64), np.asarray(errors, dtype=np.float64)
    return np.stack([((places - site) ** 2).sum(axis=1) <= range_m**2 for site in sites])


def place(
    errors: ArrayLike,
    poles: ArrayLike,
    range_m: float,
    count: int,
    *,
    weight: ArrayLike | None = None,
    method: Method = "exact",
) -> Placement:
    """Return the `count` of the poles (P, 3) that cover most of the weight (E,) of the errors (E, 3).

    Positions are in the world frame [m]. Without `weight` each error weighs 1. Among equal choices earlier poles are
    preferred. Raises `InputError` where positions, weights, range, count or method are invalid.

    >>> from flcav import place
    >>> placed = place([[0, 0, 1], [5, 0, 1], [90, 0, 1]], poles=[[0, 9, 3], [90, 9, 3]], range_m=40, count=1)
    >>> placed.chosen, placed.covered, placed.optimal
    ((0,), 2, True)
    """
    places, sites = _points(errors, "errors"), _points(poles, "poles")
    weights = np.ones(len(places)) if weight is None else np.asarray(weight, dtype=np.float64)
    if weights.shape != (len(places),) or not np.all((weights == 0) | (weights >= 1e-9) & (weights <= 1e9)):
        raise InputError("errors: every weight must be 0, or a number from 1e-09 to 1e+09")
    if not 0 < range_m <= FARTHEST_M:
        raise InputError(f"range = {range_m}: must be a positive number of metres, at most {FARTHEST_M:g}")
    if not 1 <= count <= len(sites):
        raise InputError(f"count = {count}: must be from 1 to the number of poles, {len(sites)}")
    if method not in ("exact", "greedy"):
        raise InputError(f"method = {method!r}: must be exact or greedy")
    within = coverage(places, sites, range_m)
    patterns, pattern_weight = _patterns(within, weights)
    chosen = _greedy(patterns, pattern_weight, count)
    best = float(pattern_weight[patterns[chosen].any(axis=0)].sum())
    bound = _bound(patterns, pattern_weight, count)
    if method == "exact" and bound > best * (1 + TIE):
        chosen, bound = _exact(patterns, pattern_weight, count)
    chosen = _earliest(patterns, pattern_weight, chosen)
    reached = within[chosen].any(axis=0)
    covered_weight = float(weights[reached].sum())
    optimal = bound <= covered_weight * (1 + TIE) + TIE
    return Placement(
        tuple(chosen), int(reached.sum()), covered_weight, covered_weight if optimal else float(bound), optimal
    )


def _points(values: ArrayLike, name: str) -> Array:
    points = np.asarray(values, dtype=np.float64)
    if points.size == 0:
        raise InputError(f"{name}: there are none")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name}: expected rows of x, y, z, found an array of shape {points.shape}")
    odd = np.flatnonzero(~(np.abs(points) <= FARTHEST_M).all(axis=1))
    if len(odd):
        raise InputError(f"{name}: row {int(odd[0]) + 1} is not finite, or farther than {FARTHEST_M:g} m")
    return points


def _patterns(within: NDArray[np.bool_], weights: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return the K distinct sets of poles that cover an error, as columns (P, K), and the weight (K,) of their errors.

    Errors with the same set of poles are merged: the problem's size is K, not E.
    """
    seen = within.any(axis=0)
    if not seen.any():
        return np.zeros((len(within), 0), dtype=bool), np.zeros(0)
    patterns, number = np.unique(np.packbits(within[:, seen], axis=0), axis=1, return_inverse=True)
    total = np.bincount(number.ravel(), weights[seen]).astype(np.float64)
    return np.unpackbits(patterns, axis=0, count=len(within)).astype(bool), total


def _greedy(patterns: NDArray[np.bool_], weight: Array, count: int) -> list[int]:
    """Return `count` poles by the greedy algorithm: each adds most weight; the earliest among equals."""
    left = weight.copy()
    chosen: list[int] = []
    for _ in range(count):
        gain = patterns @ left
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain >= gain.max() - TIE * abs(gain.max()))))
        left[patterns[chosen[-1]]] = 0.0
    return sorted(chosen)


def _program(patterns: NDArray[np.bool_], weight: Array, count: int) -> tuple[Array, csr_array, Array]:
    """Return objective, constraint rows and upper limits of the program over the variables (poles, patterns).

    A pattern is covered only where one of its poles is chosen, and at most `count` poles are chosen.
    """
    poles, kinds = patterns.shape
    cover = hstack((csr_array(-patterns.T.astype(np.float64)), eye_array(kinds)))
    choose = csr_array(np.r_[np.ones(poles), np.zeros(kinds)][None])
    return np.r_[np.zeros(poles), -weight], csr_array(vstack((cover, choose))), np.r_[np.zeros(kinds), float(count)]


def _bound(patterns: NDArray[np.bool_], weight: Array, count: int) -> float:
    """Return the bound of the linear programming relaxation on the covered weight."""
    if count == 1 or not patterns.shape[1]:
        return float((patterns @ weight).max())
    objective, rows, limits = _program(patterns, weight, count)
    return -float(linprog(objective, A_ub=rows, b_ub=limits, bounds=(0, 1), method="highs").fun)


def _exact(patterns: NDArray[np.bool_], weight: Array, count: int) -> tuple[list[int], float]:
    """Return an optimal choice of `count` poles and the proven upper bound, by mixed-integer programming."""
    objective, rows, limits = _program(patterns, weight, count)
    whole = np.r_[np.ones(len(patterns)), np.zeros(patterns.shape[1])]
    result = milp(
        objective,
        integrality=whole,
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(rows, ub=limits),  # pyright: ignore[reportArgumentType]
        options={"mip_rel_gap": 0.0},
    )
    chosen = [int(pole) for pole in np.flatnonzero(result.x[: len(patterns)] > 0.5)]
    unused = [pole for pole in range(len(patterns)) if pole not in chosen]
    return sorted(chosen + unused[: count - len(chosen)]), -float(result.mip_dual_bound)


def _earliest(patterns: NDArray[np.bool_], weight: Array, chosen: list[int]) -> list[int]:
    """Return the choice with each pole replaced by the earliest one that loses no covered weight."""
    best = float(weight[patterns[chosen].any(axis=0)].sum())
    for pole in sorted(chosen):
        others = [other for other in chosen if other != pole]
        value = weight @ (patterns | patterns[others].any(axis=0)).T
        equal = np.flatnonzero(value >= best * (1 - TIE))
        chosen = sorted([*others, next(int(p) for p in equal if p not in others)])
    return chosen
