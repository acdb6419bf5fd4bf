"""Greedy rounding under linear budgets: remove units at the least loss per price, add them at the most gain."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flcav.geometry.arrays import Array
from flcav.optimization.solvers.separable import BUDGET_SLACK


class Budgeted(Protocol):
    """A problem of n integer quantities under L budgets, whose error falls as any quantity grows."""

    @property
    def low(self) -> Array:
        """Least of each quantity (n,)."""
        ...

    @property
    def high(self) -> Array:
        """Most of each quantity (n,)."""
        ...

    @property
    def cost(self) -> Array:
        """Cost of one unit of each quantity under each budget (n, L)."""
        ...

    @property
    def budget(self) -> Array:
        """Budgets (L,)."""
        ...

    def change(self, x: Array, step: int) -> Array:
        """Return the change of the total error (n,) when one quantity at a time changes by `step`."""
        ...


def trim(problem: Budgeted, x: Array, prices: Array) -> Array:
    """Return integers x (n,) with units removed until they fit the budgets, those of least loss per price first.

    `prices` (n,) are the prices of one unit of each quantity.
    """
    x = x.copy()
    allowed = problem.budget * (1 + BUDGET_SLACK)
    while np.any(over := x @ problem.cost > allowed):
        with np.errstate(divide="ignore", invalid="ignore"):
            loss = problem.change(x, -1) / prices
        useful = np.flatnonzero((x > problem.low) & (problem.cost[:, over] > 0).any(axis=1))
        order = useful[np.argsort(loss[useful])]
        freed = np.cumsum(problem.cost[order], axis=0)
        needed = x @ problem.cost - allowed
        enough = np.all(freed >= needed, axis=1)
        x[order[: int(np.argmax(enough)) + 1 if enough.any() else len(order)]] -= 1
    return x


def fill(problem: Budgeted, x: Array, prices: Array) -> Array:
    """Return integers x (n,) with units added while one fits the budgets and gains, those of most gain per price first.

    `prices` (n,) are the prices of one unit of each quantity.
    """
    x = x.copy()
    while True:
        left = problem.budget * (1 + BUDGET_SLACK) - x @ problem.cost
        possible = np.flatnonzero((x < problem.high) & np.all(problem.cost <= left, axis=1))
        if not len(possible):
            return x
        gain = -problem.change(x, 1)[possible]
        possible, gain = possible[gain > 0], gain[gain > 0]
        if not len(possible):
            return x
        with np.errstate(divide="ignore"):
            order = possible[np.argsort(-gain / prices[possible], kind="stable")]
        fitting = np.all(np.cumsum(problem.cost[order], axis=0) <= left, axis=1)
        x[order[: int(np.argmin(fitting)) if not fitting.all() else len(order)]] += 1


def outermost(good: Callable[[Array], NDArray[np.bool_]], inside: Array, edge: Array) -> Array:
    """Return, by bisection, the integers nearest to `edge` for which `good` holds, elementwise.

    `good` must hold at `inside`, and from there towards `edge` up to a single change.
    """
    while np.any(inside != edge):
        middle = np.where(edge < inside, np.floor((edge + inside) / 2), np.ceil((edge + inside) / 2))
        reached = good(middle)
        edge = np.where(reached, edge, middle + np.sign(inside - middle))
        inside = np.where(reached, middle, inside)
    return inside
