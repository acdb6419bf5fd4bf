"""VRCSP: which poles get a roadside sensor, so that the sensors cover most of the registered errors.

An error at e is covered by a sensor at x where ||e - x|| <= range in three dimensions. Choosing `count` poles is the
maximum coverage problem: greedy is within 1 - 1/e of the optimum (Nemhauser, Wolsey and Fisher 1978); exact is a
mixed-integer program for HiGHS, with a proven bound.
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

FARTHEST_M = 1e9
TIE = 1e-9  # relative: covered weights closer than this are equal


@dataclass(frozen=True)
class Placement:
    """The chosen poles and what they cover."""

    chosen: tuple[int, ...]  # indices into the poles, ascending
    covered: int  # errors within range of a chosen pole
    covered_weight: float
    upper_bound: float  # proven: no choice covers more weight
    optimal: bool  # the bound is reached


def coverage(errors: ArrayLike, poles: ArrayLike, range_m: float) -> NDArray[np.bool_]:
    """Return (P, E): whether pole p (P, 3) is within `range_m` of error e (E, 3), both in the world frame [m]."""
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
    """Return which `count` of the poles (P, 3) cover most of the weight (E,) of the errors (E, 3), all in metres.

    Without `weight` each error weighs 1. Among equal choices earlier poles are preferred. Raises `InputError` for rows
    that are no places, and for a range, a count or a method that cannot be.

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
    """Return (P, K) distinct sets of poles that see an error, and the weight (K,) of the errors each set sees."""
    seen = within.any(axis=0)
    if not seen.any():
        return np.zeros((len(within), 0), dtype=bool), np.zeros(0)
    patterns, number = np.unique(np.packbits(within[:, seen], axis=0), axis=1, return_inverse=True)
    total = np.bincount(number.ravel(), weights[seen]).astype(np.float64)
    return np.unpackbits(patterns, axis=0, count=len(within)).astype(bool), total


def _greedy(patterns: NDArray[np.bool_], weight: Array, count: int) -> list[int]:
    """Return `count` poles, each the one that adds most weight; the earliest among equals."""
    left = weight.copy()
    chosen: list[int] = []
    for _ in range(count):
        gain = patterns @ left
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain >= gain.max() - TIE * abs(gain.max()))))
        left[patterns[chosen[-1]]] = 0.0
    return sorted(chosen)


def _program(patterns: NDArray[np.bool_], weight: Array, count: int) -> tuple[Array, csr_array, Array]:
    """Return the objective, rows and limits over (poles, patterns): a pattern counts where one of its poles does."""
    poles, kinds = patterns.shape
    cover = hstack((csr_array(-patterns.T.astype(np.float64)), eye_array(kinds)))
    choose = csr_array(np.r_[np.ones(poles), np.zeros(kinds)][None])
    return np.r_[np.zeros(poles), -weight], csr_array(vstack((cover, choose))), np.r_[np.zeros(kinds), float(count)]


def _bound(patterns: NDArray[np.bool_], weight: Array, count: int) -> float:
    """Return the linear programming bound on the covered weight."""
    if count == 1 or not patterns.shape[1]:
        return float((patterns @ weight).max())
    objective, rows, limits = _program(patterns, weight, count)
    return -float(linprog(objective, A_ub=rows, b_ub=limits, bounds=(0, 1), method="highs").fun)


def _exact(patterns: NDArray[np.bool_], weight: Array, count: int) -> tuple[list[int], float]:
    """Return an optimal choice of `count` poles and the proven bound."""
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
    """Return the choice with poles swapped for earlier ones as long as that loses no weight."""
    best = float(weight[patterns[chosen].any(axis=0)].sum())
    for pole in sorted(chosen):
        others = [other for other in chosen if other != pole]
        value = weight @ (patterns | patterns[others].any(axis=0)).T
        equal = np.flatnonzero(value >= best * (1 - TIE))
        chosen = sorted([*others, next(int(p) for p in equal if p not in others)])
    return chosen
