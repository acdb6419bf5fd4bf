"""Budgeted maximum coverage and its converse as mixed-integer programs, solved by HiGHS."""

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp
from scipy.sparse import csr_array, eye_array, hstack, vstack

from flcav.optimization.placement.instance import Array, CoverageInstance

NODES = 2000  # of the search tree at most, where a limit is asked for


def bound_by_highs(instance: CoverageInstance, budget: float) -> tuple[float, Array]:
    """Return the bound of the linear relaxation on the weight covered within `budget`, and its dual (K,) by group."""
    groups = len(instance.weight)
    if not groups:
        return 0.0, np.zeros(0)
    objective, rows, limits = _program(instance, budget)
    result = linprog(objective, A_ub=rows, b_ub=limits, bounds=(0, 1), method="highs")
    return -float(result.fun), np.clip(-result.ineqlin.marginals[:groups], 0.0, instance.weight)


def maximise_coverage(
    instance: CoverageInstance, budget: float, *, limited: bool = False
) -> tuple[list[int] | None, float]:
    """Return the candidates within `budget` that cover most weight, and a proven bound on it.

    `limited`: search NODES nodes at most; None where no choice was found by then.
    """
    objective, rows, limits = _program(instance, budget)
    return _solve(instance, objective, rows, limits, limited, sign=-1.0)


def minimise_cost(
    instance: CoverageInstance, target: float, *, limited: bool = False
) -> tuple[list[int] | None, float]:
    """Return the cheapest candidates that cover `target` of the weight, and a proven lower bound on the cost.

    `limited` as in `maximise_coverage`.
    """
    _, rows, limits = _program(instance, np.inf)
    candidates = len(instance.cost)
    share = csr_array(np.r_[np.zeros(candidates), -instance.weight][None] / target)
    rows, limits = csr_array(vstack((rows, share))), np.r_[limits, -1.0]
    cost = np.r_[instance.cost, np.zeros(len(instance.weight))]
    return _solve(instance, cost, rows, limits, limited, sign=1.0)


def _program(instance: CoverageInstance, budget: float) -> tuple[Array, csr_array, Array]:
    """Return objective, constraint rows and upper limits of the program over the variables (candidates, groups).

    A group is covered only where one of its candidates is chosen; the chosen cost at most `budget`, and a pole has one.
    """
    candidates, groups = instance.covers.shape  # pyright: ignore[reportGeneralTypeIssues]
    rows = [hstack((csr_array(-instance.covers.T.tocsr()), eye_array(groups)))]
    limits = [np.zeros(groups)]
    if np.isfinite(budget):
        rows.append(csr_array(np.r_[instance.cost, np.zeros(groups)][None]))
        limits.append(np.array([float(budget)]))
    if instance.sensors > 1:
        starts = np.arange(0, candidates + 1, instance.sensors)
        one = csr_array((np.ones(candidates), np.arange(candidates), starts))
        rows.append(hstack((one, csr_array((one.shape[0], groups)))))  # pyright: ignore[reportOptionalSubscript]
        limits.append(np.ones(one.shape[0]))  # pyright: ignore[reportOptionalSubscript]
    return np.r_[np.zeros(candidates), -instance.weight], csr_array(vstack(rows)), np.concatenate(limits)


def _solve(
    instance: CoverageInstance, objective: Array, rows: csr_array, limits: Array, limited: bool, sign: float
) -> tuple[list[int] | None, float]:
    """Return the choice that minimises `objective`, and `sign` times its bound."""
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
    return chosen, sign * bound
