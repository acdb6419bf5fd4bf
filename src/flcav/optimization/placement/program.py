"""Budgeted maximum coverage and its converse as mixed-integer programs, solved by HiGHS."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp
from scipy.sparse import csr_array, eye_array, hstack, vstack

from flcav.geometry.arrays import Array
from flcav.optimization.placement.instance import TIE, CoverageInstance, as_float, common_unit, reach

NODES = 2000  # of the search tree at most, where a limit is asked for
CUTS = 20  # times that a choice beyond a limit, within HiGHS' tolerances, is excluded and the program solved again
LARGEST = 1e6  # sum to which weights or costs are scaled, so that tolerances of 1e-6 are small relative to it
SMALLEST = 1e-7  # of scaled weights and costs that are not 0
COARSE = 100_000  # times their common unit up to which HiGHS can distinguish sums


def bound_by_highs(instance: CoverageInstance, budget: float) -> tuple[float, Array]:
    """Return the bound of the linear relaxation on the weight covered within `budget`, and the dual (K,) by group."""
    groups = len(instance.weight)
    if not groups:
        return 0.0, np.zeros(0)
    objective, rows, limits, scale = _program(instance, budget)
    result = linprog(objective, A_ub=rows, b_ub=limits, bounds=(0, 1), method="highs")
    if result.fun is None:  # the range of numbers is too wide for HiGHS
        return float(instance.weight.sum()), np.zeros(groups)
    return -float(result.fun) / scale, np.clip(-result.ineqlin.marginals[:groups] / scale, 0.0, instance.weight)


def maximise_coverage(
    instance: CoverageInstance, budget: int, *, limited: bool = False
) -> tuple[list[int] | None, float]:
    """Return the candidates within the exact `budget` that cover the most weight, and HiGHS' upper bound on it.

    With `limited` at most NODES nodes are searched, and the choice is None where none was found by then.
    """
    objective, rows, limits, scale = _program(instance, as_float(budget))
    chosen = None
    bound = -np.inf
    for _ in range(CUTS):
        chosen, bound = _solve(instance, objective, rows, limits, limited)
        # HiGHS' tolerances may let a choice exceed the budget slightly: a cut excludes it, and it is solved again.
        if chosen is None or instance.cost_of(chosen) <= budget:
            break
        for candidate in sorted(chosen, key=lambda each: instance.price[each]):
            if instance.cost_of(chosen) - instance.price[candidate] > budget:
                chosen.remove(candidate)
        beyond = np.zeros(rows.shape[1])  # pyright: ignore[reportOptionalSubscript]
        beyond[chosen] = 1.0
        rows = csr_array(vstack((rows, csr_array(beyond[None]))))
        limits = np.r_[limits, len(chosen) - 1.0]
        chosen = None
    return chosen, -bound / scale


def minimise_cost(instance: CoverageInstance, target: int, *, limited: bool = False) -> tuple[list[int] | None, float]:
    """Return the cheapest candidates that cover the exact weight `target`, and HiGHS' lower bound on the cost.

    `limited` is as in `maximise_coverage`.
    """
    objective, rows, limits, scale = _program(instance, np.inf)
    candidates = len(instance.cost)
    weight = csr_array(np.r_[np.zeros(candidates), objective[candidates:]][None])
    rows = csr_array(vstack((rows, weight)))
    limits = np.r_[limits, -as_float(target) * scale]
    costs, unit = _scale(instance.cost, instance.price.tolist())
    cost = np.r_[costs, np.zeros(len(instance.weight))]
    chosen = None
    bound = -np.inf
    for _ in range(CUTS):
        chosen, bound = _solve(instance, cost, rows, limits, limited)
        if chosen is None or instance.worth_of(chosen) >= target:
            break
        missing = target - instance.worth_of(chosen)
        has = reach(instance.covers, chosen)
        for candidate in range(
            candidates
        ):  # extend the choice while it misses the target: a cut excludes all its subsets
            groups = [group for group in instance.covered_by(candidate).tolist() if not has[group]]
            if (gain := sum(instance.worth[groups].tolist())) < missing:
                missing -= gain
                has[groups] = True
                chosen.append(candidate)
        more = np.zeros(rows.shape[1])  # pyright: ignore[reportOptionalSubscript]
        more[:candidates] = -1.0
        more[chosen] = 0.0
        rows = csr_array(vstack((rows, csr_array(more[None]))))
        limits = np.r_[limits, -1.0]
        chosen = None
    return chosen, bound / unit


def is_coarse(units: Sequence[int]) -> bool:
    """Return whether HiGHS can distinguish the sums of such numbers within its tolerances."""
    return sum(units) <= COARSE * common_unit(units)


def is_wide(units: Sequence[int]) -> bool:
    """Return whether the least of such numbers is lost in HiGHS' tolerances relative to their sum."""
    return 2 * TIE * sum(units) > min(filter(None, units), default=0)


def _scale(values: Array, units: Sequence[int]) -> tuple[Array, float]:
    """Return weights or costs scaled for HiGHS, and the factor: to small integers if possible, else to the sum LARGEST.

    In the latter case values too small for HiGHS relative to the sum become 0. `units` are the exact values.
    """
    if is_coarse(units):
        factor = 1 / as_float(common_unit(units)) if any(units) else 1.0
        return values * factor, factor
    factor = LARGEST / as_float(sum(units))
    return np.where(values * factor < SMALLEST, 0.0, values * factor), factor


def _program(instance: CoverageInstance, budget: float) -> tuple[Array, csr_array, Array, float]:
    """Return objective, constraint rows, their upper limits, and the scale of weights in the objective.

    Variables are (candidates, groups). A group is covered only where one of its candidates is chosen; the chosen ones
    cost at most `budget`, and a pole has at most one.
    """
    weight, scale = _scale(instance.weight, instance.worth.tolist())
    candidates, groups = instance.covers.shape  # pyright: ignore[reportGeneralTypeIssues]
    rows = [hstack((csr_array(-instance.covers.T.tocsr()), eye_array(groups)))]
    limits = [np.zeros(groups)]
    if np.isfinite(budget):
        dear = instance.cost > budget  # and never chosen: each costs twice the budget
        cost, unit = _scale(instance.cost, np.where(dear, 0, instance.price).tolist())
        rows.append(csr_array(np.r_[np.where(dear, 2 * budget * unit + 1, cost), np.zeros(groups)][None]))
        limits.append(np.array([budget * unit]))
    if instance.sensors > 1:
        starts = np.arange(0, candidates + 1, instance.sensors)
        one = csr_array((np.ones(candidates), np.arange(candidates), starts))
        rows.append(hstack((one, csr_array((one.shape[0], groups)))))  # pyright: ignore[reportOptionalSubscript]
        limits.append(np.ones(one.shape[0]))  # pyright: ignore[reportOptionalSubscript]
    return np.r_[np.zeros(candidates), -weight], csr_array(vstack(rows)), np.concatenate(limits), scale


def _solve(
    instance: CoverageInstance, objective: Array, rows: csr_array, limits: Array, limited: bool
) -> tuple[list[int] | None, float]:
    """Return the choice that minimises `objective`, and the dual bound on its value."""
    candidates, groups = instance.covers.shape  # pyright: ignore[reportGeneralTypeIssues]
    options = {"mip_rel_gap": 0.0} | ({"node_limit": NODES} if limited else {})
    result = milp(
        objective,
        integrality=np.r_[np.ones(candidates), np.zeros(groups)],
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(rows, ub=limits),  # pyright: ignore[reportArgumentType]
        options=options,
    )
    chosen = None if result.x is None else [int(k) for k in np.flatnonzero(result.x[:candidates] > 0.5)]
    bound = -np.inf if result.mip_dual_bound is None else float(result.mip_dual_bound)
    return chosen, bound
