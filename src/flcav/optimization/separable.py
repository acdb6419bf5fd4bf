"""Sums of inverse powers under two budgets: the continuous optimum by its dual, and a good integer point.

    minimise sum_j a_j (x_j + x0_j)^(-b_j)   subject to   sum_j cost_jl x_j <= budget_l,   low_j <= x_j <= high_j

At multipliers l >= 0 each x_j has a closed form: its marginal gain a b (x + x0)^(-b-1) equals its price p = cost . l,
or it stands at a bound (water-filling). The dual is concave in the two multipliers; its gradient is the overspend.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LARGEST_STEP = 4.0  # of a multiplier's logarithm in one iteration
BUDGET_SLACK = 1e-12  # relative: rounding of the sums, not room to overspend


@dataclass(frozen=True)
class Separable:
    """A problem of n quantities; `low` is within the budgets, and finite error there."""

    a: Array  # (n,)
    b: Array  # (n,)
    x0: Array  # (n,)
    low: Array  # (n,) whole numbers
    high: Array  # (n,) whole numbers
    cost: Array  # (n, 2) of one unit on each link
    budget: Array  # (2,)

    def error(self, x: Array) -> Array:
        """Return the (n,) errors at x (n,)."""
        return self.a * (x + self.x0) ** -self.b

    def cheapest(self, multipliers: Array) -> Array:
        """Return the (n,) quantities that minimise error plus cost at `multipliers` (2,)."""
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            level = (self.a * self.b / (self.cost @ multipliers)) ** (1 / (self.b + 1)) - self.x0
        return np.clip(np.where(self.a > 0, level, self.low), self.low, self.high)

    def fits(self, x: Array) -> bool:
        """Return whether x (n,) is within the budgets."""
        return bool(np.all(x @ self.cost <= self.budget * (1 + BUDGET_SLACK)))


@dataclass(frozen=True)
class Relaxed:
    """The continuous optimum."""

    x: Array  # (n,)
    multipliers: Array  # (2,) error saved per unit of each budget
    bound: float  # the dual value: no plan within the budgets has less error


def relax(problem: Separable) -> Relaxed:
    """Return the continuous optimum: the first set of binding budgets whose multipliers leave the others unbroken."""
    best = _value(problem, np.zeros(2))
    for binding in ((), (0,), (1,), (0, 1)):
        best = _ascend(problem, list(binding))
        if problem.fits(best.x * (1 - 1e-9)):
            break
    return best


def _value(problem: Separable, multipliers: Array) -> Relaxed:
    x = problem.cheapest(multipliers)
    return Relaxed(x, multipliers, float(problem.error(x).sum() + multipliers @ (x @ problem.cost - problem.budget)))


def _ascend(problem: Separable, binding: list[int]) -> Relaxed:
    """Return the best dual point at which only the `binding` budgets have a multiplier: Newton in its logarithm."""
    multipliers = np.zeros(2)
    middle = (problem.low + problem.high) / 2
    gain = problem.error(middle) * problem.b / (middle + problem.x0 + 1)
    multipliers[binding] = gain.sum() / np.maximum((problem.cost[:, binding]).sum(axis=0), 1e-300)
    now = _value(problem, multipliers)
    for _ in range(200 if binding else 0):
        overspend = now.x @ problem.cost[:, binding] - problem.budget[binding]
        if np.all(np.abs(overspend) <= 1e-10 * problem.budget[binding]):
            break
        step = _newton(problem, now, binding, overspend)
        following = now
        for shrink in 0.5 ** np.arange(40):
            multipliers = now.multipliers.copy()
            multipliers[binding] *= np.exp(step * shrink)
            following = _value(problem, multipliers)
            if following.bound > now.bound:
                break
        else:
            break
        now = following
    return now


def _newton(problem: Separable, now: Relaxed, binding: list[int], overspend: Array) -> Array:
    """Return the Newton step of the logarithms of the binding multipliers, made an ascent direction and capped."""
    cost, scale = problem.cost[:, binding], now.multipliers[binding]
    prices = problem.cost @ now.multipliers
    inside = (now.x > problem.low) & (now.x < problem.high) & (prices > 0)
    bend = (now.x + problem.x0)[inside] / ((problem.b + 1)[inside] * prices[inside])
    curvature = (cost[inside] * bend[:, None]).T @ cost[inside] * np.outer(scale, scale)
    gradient = overspend * scale
    ridge = 1e-12 * max(float(np.trace(curvature)), float(np.abs(gradient).max()))
    step = np.linalg.solve(curvature + ridge * np.eye(len(binding)), gradient)
    return np.asarray(step * min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), 1e-300)), dtype=np.float64)


def whole_bound(problem: Separable, multipliers: Array) -> float:
    """Return the dual value over whole quantities: no whole plan within the budgets has less error."""
    below = np.floor(problem.cheapest(multipliers))
    prices = problem.cost @ multipliers
    total = np.minimum(*(problem.error(x) + prices * x for x in (below, np.minimum(below + 1, problem.high))))
    return float(total.sum() - multipliers @ problem.budget)


def round_down(problem: Separable, relaxed: Relaxed) -> Array:
    """Return whole (n,) quantities within the budgets: rounded down, then filled by the best gain per price."""
    x = np.clip(np.floor(relaxed.x + 1e-9), problem.low, problem.high)
    prices = problem.cost @ (relaxed.multipliers + 1e-9 * relaxed.multipliers.sum() + 1e-300)
    while not problem.fits(x):  # by the rounding of the continuous optimum alone: a unit or so
        fewer = np.maximum(x - 1, problem.low)
        loss = np.where(x > problem.low, (problem.error(fewer) - problem.error(x)) / prices, np.inf)
        x[np.argmin(loss)] -= 1
    return fill(problem, x, prices)


def fill(problem: Separable, x: Array, prices: Array) -> Array:
    """Return whole x (n,) with units added, the best gain per price (n,) first, while any fits and gains."""
    x = x.copy()
    left = problem.budget * (1 + BUDGET_SLACK) - x @ problem.cost
    while True:
        gain = problem.error(x) - problem.error(x + 1)
        possible = (gain > 0) & (x < problem.high) & np.all(problem.cost <= left, axis=1)
        if not possible.any():
            return x
        best = np.argmax(np.where(possible, gain / prices, -np.inf))
        x[best] += 1
        left -= problem.cost[best]
