"""Budgeted maximum coverage and its converse as mixed-integer programs, solved by HiGHS."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp
from scipy.sparse import csr_array, eye_array, hstack, vstack

from flcav.geometry.arrays import Array
from flcav.optimization.placement.instance import TIE, CoverageInstance, as_float, common_unit, reach

NODES = 2000  # of the search tree at most, where a limit is asked for
CUTS = 20  # times that a choice beyond a limit, within HiGHS' tolerances, is excluded and the program solved again
LARGEST = 1e6  # sum to which weights or costs are scaled, so that tolerances of 1e-6 are small beside it
SMALLEST = 1e-7  # of scaled weights and costs that are not 0
COARSE = 100_000  # times their common unit up to which sums are told from each other by HiGHS


def bound_by_highs(instance: CoverageInstance, budget: float) -> tuple[float, Array]:
    """Return the bound of the linear relaxation on the weight covered within `budget`, and its dual (K,) by group."""
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
    """Return the candidates within the exact `budget` that cover most weight, and HiGHS' bound on it.

    `limited`: search NODES nodes at most; None where no choice was found by then.
    """
    objective, rows, limits, scale = _program(instance, as_float(budget))
    chosen, bound = None, -np.inf
    for _ in range(CUTS):
        chosen, bound = _solve(instance, objective, rows, limits, limited)
        if chosen is None or instance.cost_of(chosen) <= budget:
            break
        for candidate in sorted(chosen, key=lambda each: instance.price[each]):
            if instance.cost_of(chosen) - instance.price[candidate] > budget:
                chosen.remove(candidate)
        beyond = np.zeros(rows.shape[1])  # pyright: ignore[reportOptionalSubscript]
        beyond[chosen] = 1.0
        rows, limits = csr_array(vstack((rows, csr_array(beyond[None])))), np.r_[limits, len(chosen) - 1.0]
        chosen = None
    return chosen, -bound / scale


def minimise_cost(instance: CoverageInstance, target: int, *, limited: bool = False) -> tuple[list[int] | None, float]:
    """Return the cheapest candidates that cover the exact weight `target`, and HiGHS' lower bound on the cost.

    `limited` as in `maximise_coverage`.
    """
    objective, rows, limits, scale = _program(instance, np.inf)
    candidates = len(instance.cost)
    weight = csr_array(np.r_[np.zeros(candidates), objective[candidates:]][None])
    rows, limits = csr_array(vstack((rows, weight))), np.r_[limits, -as_float(target) * scale]
    costs, unit = _scale(instance.cost, instance.price.tolist())
    cost = np.r_[costs, np.zeros(len(instance.weight))]
    chosen, bound = None, -np.inf
    for _ in range(CUTS):
        chosen, bound = _solve(instance, cost, rows, limits, limited)
        if chosen is None or instance.worth_of(chosen) >= target:
            break
        missing, has = target - instance.worth_of(chosen), reach(instance.covers, chosen)
        for candidate in range(candidates):  # what covers too little still does with these
            own = [group for group in instance.covered_by(candidate).tolist() if not has[group]]
            if (gain := sum(instance.worth[own].tolist())) < missing:
                missing -= gain
                has[own] = True
                chosen.append(candidate)
        more = np.zeros(rows.shape[1])  # pyright: ignore[reportOptionalSubscript]
        more[:candidates] = -1.0
        more[chosen] = 0.0
        rows, limits = csr_array(vstack((rows, csr_array(more[None])))), np.r_[limits, -1.0]
        chosen = None
    return chosen, bound / unit


def is_coarse(units: Sequence[int]) -> bool:
    """Return whether HiGHS, within its tolerances, tells the sums of such numbers from each other."""
    return sum(units) <= COARSE * common_unit(units)


def is_wide(units: Sequence[int]) -> bool:
    """Return whether HiGHS, within its tolerances, takes the least of such numbers for none beside their sum."""
    return 2 * TIE * sum(units) > min(filter(None, units), default=0)


def _scale(values: Array, units: Sequence[int]) -> tuple[Array, float]:
    """Return weights or costs for HiGHS and their factor: whole numbers where these are small, else of the sum LARGEST.

    Then those too small for HiGHS beside the sum are 0. `units`: the values, exactly.
    """
    if is_coarse(units):
        factor = 1 / as_float(common_unit(units)) if any(units) else 1.0
        return values * factor, factor
    factor = LARGEST / as_float(sum(units))
    return np.where(values * factor < SMALLEST, 0.0, values * factor), factor


def _program(instance: CoverageInstance, budget: float) -> tuple[Array, csr_array, Array, float]:
    """Return objective, constraint rows and upper limits of the program over the variables (candidates, groups).

    A group is covered only where one of its candidates is chosen; the chosen cost at most `budget`, and a pole has one.
    The last is the factor to weights in the objective.
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
    """Return the choice that minimises `objective`, and its bound."""
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
