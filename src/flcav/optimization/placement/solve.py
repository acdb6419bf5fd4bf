"""Budgeted maximum coverage by roadside sensors, with a proven upper bound on the weight that any choice covers.

Small instances are mixed-integer programs, which HiGHS solves to optimality. For large ones the dual of the linear
relaxation gives the bound (`relaxation.py`), the fractional solution is rounded and improved by exchanges, and
candidates whose selection would lower the bound below the incumbent are removed (reduced-cost fixing); the program of
the remaining ones is small. The relaxation without variables for errors follows Cordeau, Furini and Ljubic, "Benders
decomposition for very large scale partial set covering and maximal covering location problems" (EJOR 275, 2019).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, diags_array

from flcav.config import InputError
from flcav.interface.notebook import Displayed
from flcav.optimization.placement.enumeration import improve_exactly
from flcav.optimization.placement.greedy import choose_greedily, exchange, extend_greedily
from flcav.optimization.placement.instance import (
    TIE,
    UNIT,
    Array,
    CoverageInstance,
    Units,
    as_float,
    common_unit,
    find_covered,
    in_units,
    limit_in_units,
    merge_errors,
    reach,
)
from flcav.optimization.placement.program import bound_by_highs, is_coarse, is_wide, maximise_coverage
from flcav.optimization.placement.relaxation import Relaxation, bound_by, relax

Method = Literal["exact", "greedy"]

FARTHEST_M = 1e9  # largest coordinate and range
WHOLE = 6000  # covered pairs up to which HiGHS solves the whole program
SEARCHED = 60_000  # covered pairs up to which it searches what remains of a large one
NEARLY = 1e-6  # relative difference between a choice and HiGHS' bound from which its search has not ended
SURE = 0.05  # fractional choice from which a candidate is rounded up


@dataclass(frozen=True)
class Certificate:
    """A dual solution of the linear relaxation, which proves a bound by itself, and the tighter bound of a search.

    For any budget, covered weight <= sum_e (w_e - u_e) + price budget + sum_poles max(0, max_sensors (sum of the u_e
    that the sensor covers - price cost)).
    """

    values: tuple[float, ...]  # (E,) u of each error, from 0 to its weight w
    price: float  # covered weight per unit of cost
    bound: float  # of the dual: most covered weight within the budget; of `cover_share` the least cost
    search: float | None = None  # what HiGHS claims of it instead, after a search; None: there was none


@dataclass(frozen=True)
class Placement(Displayed):
    """A placement of sensors: chosen poles, their sensors, the errors they cover, and a certificate of optimality."""

    chosen: tuple[int, ...]  # indices into the poles, ascending
    covered: int  # errors within range of a chosen pole
    covered_weight: float
    upper_bound: float  # proven: no choice of as many poles, or within the budget, covers more weight
    optimal: bool  # whether `covered_weight` equals the bound; for `cover_share`, whether `cost` equals its bound
    sensors: tuple[int, ...] = ()  # index into the sensors of each chosen pole
    cost: float = 0.0  # of the chosen
    marginal_gain: tuple[float, ...] = ()  # weight that each of the chosen alone covers: lost if it were left out
    certificate: Certificate | None = None  # None: nothing is proven


def coverage(errors: ArrayLike, poles: ArrayLike, range_m: float) -> NDArray[np.bool_]:
    """Return the coverage matrix (P, E): whether each of the `poles` (P, 3) is within `range_m` of each error (E, 3).

    Positions are in the world frame [m].
    """
    sites, places = np.asarray(poles, dtype=np.float64), np.asarray(errors, dtype=np.float64)
    return np.stack([((places - site) ** 2).sum(axis=1) <= range_m**2 for site in sites])


@dataclass(frozen=True)
class Candidates:
    """Every sensor on every pole: candidate k is the sensor `order[k % S]` on the pole k // S."""

    covers: csr_array  # (P * S, E) 1.0 where a candidate covers an error
    weight: Array  # (E,) of the errors
    cost: Array  # (P * S,)
    order: NDArray[np.int64]  # (S,) numbers of the sensors as they were given, by range
    price: Units  # (P * S,) the costs, exactly

    @cached_property
    def worth(self) -> Units:
        """Return (E,) the exact weights."""
        return in_units(self.weight)

    @property
    def sensors(self) -> int:
        """Return the number of kinds of sensors."""
        return len(self.order)

    @property
    def poles(self) -> int:
        """Return the number of poles."""
        return len(self.cost) // self.sensors

    def at_unit_cost(self) -> "Candidates":
        """Return the same candidates at a cost of 1 for every sensor."""
        ones = np.ones(len(self.cost))
        return replace(self, cost=ones, price=in_units(ones))

    def instance(self, method: Method = "exact") -> CoverageInstance:
        """Return the coverage instance, with errors that the same candidates cover merged into groups.

        Large instances are not merged for the greedy method, which takes less time than merging them.
        """
        if method == "greedy" and self.covers.nnz > SEARCHED:
            return CoverageInstance(self.covers, self.weight, self.cost, self.price, self.sensors)
        return merge_errors(self.covers, self.weight, self.cost, self.sensors, self.price, self.worth)


def find_candidates(
    errors: ArrayLike,
    poles: ArrayLike,
    ranges_m: ArrayLike,
    *,
    weight: ArrayLike | None = None,
    pole_cost: ArrayLike | None = None,
    sensor_cost: ArrayLike | None = None,
    visible: csr_array | None = None,
) -> Candidates:
    """Return all sensors of `ranges_m` (S,) [m] on all `poles` (P, 3), and which of the `errors` (E, 3) each covers.

    Positions are in the world frame [m]; `weight` (E,) is 1 where not given. A candidate costs its pole's (P,) and its
    sensor's (S,) cost, 0 where not given. An error is covered within the range, and where `visible` (P, E) is not 0.
    Raises `InputError` where positions, weights, ranges or costs are invalid.
    """
    places, sites = _points(errors, "errors"), _points(poles, "poles")
    weights = np.ones(len(places)) if weight is None else np.asarray(weight, dtype=np.float64)
    if weights.shape != (len(places),) or not np.all((weights == 0) | (weights >= 1e-9) & (weights <= 1e9)):
        raise InputError("errors: every weight must be 0, or a number from 1e-09 to 1e+09")
    if not weights.any():
        raise InputError("errors: every weight is 0")
    ranges = np.asarray(ranges_m, dtype=np.float64)
    if ranges.ndim != 1 or not len(ranges):
        raise InputError("range: one number for each kind of sensor is wanted, and one kind at least")
    for range_m in ranges.tolist():
        if not 0 < range_m <= FARTHEST_M:
            raise InputError(f"range = {range_m}: must be a positive number of metres, at most {FARTHEST_M:g}")
    of_pole = np.zeros(len(sites)) if pole_cost is None else np.asarray(pole_cost, dtype=np.float64)
    of_sensor = np.zeros(len(ranges)) if sensor_cost is None else np.asarray(sensor_cost, dtype=np.float64)
    for name, costs, wanted in (("poles", of_pole, len(sites)), ("sensors", of_sensor, len(ranges))):
        if costs.shape != (wanted,):
            raise InputError(f"{name}: {wanted} costs are wanted, and there are {costs.size}")
        if not np.all((costs == 0) | (costs >= 1e-9) & (costs <= 1e9)):
            raise InputError(f"{name}: every cost must be 0, or a number from 1e-09 to 1e+09")
    order = np.lexsort((of_sensor, ranges))
    covers = find_covered(places, sites, ranges[order])
    if visible is not None:
        covers = csr_array(covers * visible[np.repeat(np.arange(len(sites)), len(ranges))])
        covers.eliminate_zeros()
    price = (in_units(of_pole)[:, None] + in_units(of_sensor[order])).ravel()
    return Candidates(covers, weights, np.array([as_float(each) for each in price.tolist()]), order, price)


def place_count(candidates: Candidates, count: int, *, method: Method = "exact") -> Placement:
    """Return the placement of `count` sensors, at most one per pole, that covers the most weight; costs are ignored.

    Raises `InputError` where count or method are invalid.
    """
    _check_method(method)
    if not 1 <= count <= candidates.poles:
        raise InputError(f"count = {count}: must be from 1 to the number of poles, {candidates.poles}")
    instance = candidates.at_unit_cost().instance(method)
    found = maximise(instance, limit_in_units(count), method)
    kinds = candidates.sensors
    used = {candidate // kinds for candidate in found.chosen}
    unused = [pole * kinds for pole in range(candidates.poles) if pole not in used]
    chosen = sorted(found.chosen + unused[: count - len(found.chosen)])
    certificate = certify(
        candidates, instance, found.root, lower_to(instance, found.root.bound, found.chosen), found.search
    )
    return describe(candidates, _prefer_earlier(instance, chosen), found.bound, certificate)


def place_budget(candidates: Candidates, budget: float, *, method: Method = "exact") -> Placement:
    """Return the placement of sensors, at most one per pole, that covers the most weight at a cost of at most `budget`.

    Raises `InputError` where the method is invalid, or the budget is below the cheapest candidate.
    """
    _check_method(method)
    if not np.isfinite(budget):
        raise InputError(f"budget = {budget}: must be a finite number")
    limit = limit_in_units(budget)
    if limit < min(candidates.price.tolist()):
        raise InputError(f"budget = {budget:.17g}: the cheapest sensor on a pole costs {candidates.cost.min():.17g}")
    instance = candidates.instance(method)
    found = maximise(instance, limit, method)
    certificate = certify(
        candidates, instance, found.root, lower_to(instance, found.root.bound, found.chosen), found.search
    )
    return describe(candidates, found.chosen, found.bound, certificate)


@dataclass(frozen=True)
class Found:
    """A choice of candidates with the bound that proves its quality."""

    chosen: list[int]  # ascending
    bound: float  # proven: no choice covers more weight, or costs less
    root: Relaxation  # the relaxation whose dual proves a bound
    search: float | None = None  # bound that a search states above it; None: none was made


def maximise(instance: CoverageInstance, budget: int, method: Method) -> Found:
    """Return the candidates that cover the most weight within the exact `budget`, with a proven bound on the weight."""
    chosen = choose_greedily(instance, budget)
    limit = as_float(budget)
    small = instance.covers.nnz <= WHOLE
    if method == "greedy":
        root = bound_at(instance, limit) if small else bound_of_choice(instance, limit, chosen)
        if small and root.bound <= instance.value(chosen) * (1 + TIE):
            return _close(instance, instance, budget, chosen, root, None)
        return Found(chosen, lower_to(instance, root.bound, chosen), root)
    if small:
        root, rest = bound_at(instance, limit), instance
    else:
        root = relax(instance, limit, instance.value(chosen))
        chosen = improve(instance, budget, chosen, root)
        rest = keep_candidates(instance, root.bound - root.loss > instance.value(chosen) * (1 - TIE))
        # Reduced-cost fixing: a choice with candidate k covers at most `bound - loss[k]`, so that k may be dropped.
        if rest.covers.nnz > SEARCHED:
            return Found(chosen, lower_to(instance, root.bound, chosen), root)
        if not rest.covers.nnz:
            value = as_float(instance.worth_of(chosen))
            return Found(chosen, value, root, value)
    wide = is_wide(instance.worth.tolist())
    if wide or is_wide([each for each in instance.price.tolist() if each <= budget]):
        chosen, ended = improve_exactly(instance, rest, bound_at(rest, limit), budget, chosen)
        if ended:
            value = as_float(instance.worth_of(chosen))
            return Found(chosen, value, root, None if lower_to(instance, root.bound, chosen) == value else value)
    claimed = None
    if root.bound > instance.value(chosen) * (1 + TIE):
        best, claimed = maximise_coverage(rest, budget, limited=not small)
        chosen = max((chosen, best or chosen), key=instance.worth_of)
    found = _close(instance, rest, budget, chosen, root, claimed)
    return replace(found, bound=root.bound, search=None) if wide and found.search is not None else found


def _close(
    instance: CoverageInstance,
    rest: CoverageInstance,
    budget: int,
    chosen: list[int],
    root: Relaxation,
    claimed: float | None,
) -> Found:
    """Return `chosen`, or a better choice, with the least bound that is proven.

    `rest` holds the candidates among which a better choice may exist; `claimed` is the bound of HiGHS' search, None
    where it was not run. Optimality is proven where `root` leaves no sum of weights above the choice's, where HiGHS
    leaves none and can distinguish such sums, or where the search in integers completes; otherwise HiGHS is trusted to
    `TIE`.
    """
    worth, value = instance.worth.tolist(), as_float(instance.worth_of(chosen))
    if claimed is None and lower_to(instance, root.bound, chosen) == value:
        return Found(chosen, value, root)
    claimed = root.bound if claimed is None else claimed
    if is_coarse(worth) and claimed < value + as_float(common_unit(worth)) / 2:
        # Sums of weights are multiples of their common unit: none lies within half a unit above the value.
        return Found(chosen, value, root, value)
    if claimed <= value * (1 + NEARLY):
        chosen, ended = improve_exactly(instance, rest, bound_at(rest, as_float(budget)), budget, chosen)
        value = as_float(instance.worth_of(chosen))
        if ended:
            return Found(chosen, value, root, value)
    bound = min(root.bound, max(claimed, value))
    return Found(chosen, value if bound <= value * (1 + TIE) else bound, root, bound)


def bound_at(instance: CoverageInstance, budget: float) -> Relaxation:
    """Return the bound that the dual of HiGHS' linear relaxation proves."""
    return bound_by(instance, budget, bound_by_highs(instance, budget)[1], np.zeros(len(instance.cost)))


def lower_to(instance: CoverageInstance, bound: float, chosen: Sequence[int]) -> float:
    """Return the covered weight of `chosen` where `bound` excludes every greater sum of weights; else `bound`."""
    value = instance.value(chosen)
    if bound > value * (1 + TIE):
        return bound
    worth = instance.worth_of(chosen)
    return (
        min(bound, as_float(worth)) if Fraction(bound) / UNIT < worth + common_unit(instance.worth.tolist()) else bound
    )


def certify(
    candidates: Candidates, instance: CoverageInstance, root: Relaxation, bound: float, search: float | None
) -> Certificate:
    """Return the certificate of the `root` relaxation; a group's dual is divided over its errors by their weights."""
    values = root.dual
    if instance.group is not None:
        share = np.divide(values, instance.weight, out=np.ones(len(values)), where=instance.weight > 0)
        values = np.minimum(np.r_[share, 1.0][instance.group], 1.0) * candidates.weight
    return Certificate(tuple(values.tolist()), root.price, bound, search)


def bound_of_choice(instance: CoverageInstance, budget: float, chosen: Sequence[int]) -> Relaxation:
    """Return the bound that a choice proves: its covered weight, and the most that the budget could add to it."""
    left = np.where(reach(instance.covers, chosen), 0.0, instance.weight)
    return bound_by(instance, budget, left, np.zeros(len(instance.cost)))


def improve(instance: CoverageInstance, budget: int, chosen: Sequence[int], relaxed: Relaxation) -> list[int]:
    """Return the better of `chosen` and the rounded relaxation, improved by exchanges."""
    kinds, spent, taken = instance.sensors, 0, {}
    for candidate in np.argsort(-relaxed.share, kind="stable").tolist():
        fits = spent + instance.price[candidate] <= budget
        if relaxed.share[candidate] >= SURE and fits and candidate // kinds not in taken:
            taken[candidate // kinds] = candidate
            spent += instance.price[candidate]
    rounded = extend_greedily(instance, budget, taken.values())
    best = max((list(chosen), rounded), key=instance.value)
    if relaxed.bound <= instance.value(best) * (1 + TIE):
        return best
    return exchange(instance, budget, best)


def keep_candidates(instance: CoverageInstance, kept: NDArray[np.bool_]) -> CoverageInstance:
    """Return the instance in which only the candidates `kept` (N,) cover anything, with its groups merged again."""
    covers = csr_array(diags_array(kept.astype(np.float64)) @ instance.covers)
    covers.eliminate_zeros()
    return merge_errors(covers, instance.weight, instance.cost, instance.sensors, instance.price, instance.worth)


def describe(
    candidates: Candidates,
    chosen: Sequence[int],
    bound: float,
    certificate: Certificate | None = None,
    optimal: bool | None = None,
) -> Placement:
    """Return the placement of the `chosen` candidates, with the proven `bound` on the weight that could be covered.

    Cost and weight are exact sums, rounded once. It is optimal where the bound is no more than the weight.
    """
    times = np.bincount(candidates.covers[np.asarray(chosen, np.int64)].indices, minlength=len(candidates.weight))
    weight = as_float(sum(in_units(candidates.weight[times > 0]).tolist()))
    exact = bound <= weight
    once = np.where(times == 1, candidates.weight, 0.0)
    return Placement(
        chosen=tuple(candidate // candidates.sensors for candidate in chosen),
        covered=int((times > 0).sum()),
        covered_weight=weight,
        upper_bound=weight if exact else float(bound),
        optimal=exact if optimal is None else optimal,
        sensors=tuple(int(candidates.order[candidate % candidates.sensors]) for candidate in chosen),
        cost=as_float(sum(candidates.price[[*chosen]].tolist())),
        marginal_gain=tuple((candidates.covers[np.asarray(chosen, np.int64)] @ once).tolist()),
        certificate=certificate,
    )


def _check_method(method: str) -> None:
    if method not in ("exact", "greedy"):
        raise InputError(f"method = {method!r}: must be exact or greedy")


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


def _prefer_earlier(instance: CoverageInstance, chosen: Sequence[int]) -> list[int]:
    """Return the choice with each candidate replaced by the earliest one on a free pole that covers as much weight."""
    kinds = instance.sensors
    chosen = list(chosen)
    for candidate in sorted(chosen):
        others = [other for other in chosen if other != candidate]
        left = np.where(reach(instance.covers, others), 0.0, instance.weight)
        gain = instance.covers @ left
        taken = {other // kinds for other in others}

        def gain_of(index: int, left: Array = left) -> int:
            groups = instance.covered_by(index)
            return (
                sum(in_units(left[groups]).tolist())
                if instance.summed is None
                else sum(instance.summed[groups[left[groups] > 0]])
            )

        needed = gain_of(candidate)
        close = np.flatnonzero(gain >= gain[candidate] * (1 - TIE)).tolist()
        chosen = sorted([*others, next(k for k in close if k // kinds not in taken and gain_of(k) >= needed)])
    return chosen
