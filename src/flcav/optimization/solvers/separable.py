"""Separable convex programs of inverse powers under linear budgets: the continuous optimum by Lagrangian duality.

    minimise sum_m a_m (x_of(m) + x0_m)^(-b_m)   subject to   sum_j cost_jl x_j <= budget_l,   low_j <= x_j <= high_j

At multipliers lambda >= 0, x_j is the point at which its marginal gain equals its price p_j = sum_l cost_jl lambda_l,
or a bound (water-filling). For a single power it is (a b / p)^(1 / (b + 1)) - x0; for several, Newton's method finds
it, starting from the largest of the single powers' points. The dual function is concave in the multipliers, and its
gradient is the overspend. All steps are vectorised over the quantities. `solve_two_budgets` is for two budgets,
the rest for any.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flcav.geometry.arrays import Array

LARGEST_STEP = 4.0  # of a multiplier's logarithm in one iteration
BUDGET_SLACK = 1e-12  # relative tolerance of budgets, for rounding of sums
CONVERGED = 1e-10  # relative tolerance of the overspend, and of complementary slackness
ALMOST = 1e-9  # relative overspend allowed to a converged optimum
ROUNDING = 1e-14  # relative noise of the dual's value
VANISHED = 1e-9  # a multiplier below this share of its first value belongs to a budget that does not bind
NO_DECAY = -1e9  # in place of the logarithm of a = 0


@dataclass(frozen=True)
class Separable:
    """A separable program of n quantities and m >= n inverse powers.

    `low` must be within the budgets, and the error there finite.
    """

    a: Array  # (m,) >= 0
    b: Array  # (m,) > 0
    x0: Array  # (m,) >= 0
    low: Array  # (n,) whole numbers
    high: Array  # (n,) whole numbers
    cost: Array  # (n, L) of one unit under each budget, >= 0
    budget: Array  # (L,)
    of: NDArray[np.intp] | None = None  # (m,) the quantity of each power; default: one each, in order

    def error(self, x: Array) -> Array:
        """Return the error (n,) of each quantity at x (n,): the sum of its inverse powers."""
        if self.of is None:
            return self.a * (x + self.x0) ** -self.b
        return self._summed(self.a * (x[self.of] + self.x0) ** -self.b)

    def fits(self, x: Array) -> bool:
        """Return whether x (n,) is within the budgets."""
        return bool(np.all(self.spent(x) <= self.budget * (1 + BUDGET_SLACK)))

    def spent(self, x: Array) -> Array:
        """Return the cost of x (n,) under each budget (L,)."""
        return np.array([x @ column for column in self._columns])

    def prices(self, multipliers: Array) -> Array:
        """Return the price (n,) of one unit of each quantity at `multipliers` (L,)."""
        prices = multipliers[0] * self._columns[0]
        for multiplier, column in zip(multipliers[1:], self._columns[1:]):
            prices = prices + multiplier * column
        return prices

    def minimise_lagrangian(self, multipliers: Array) -> Array:
        """Return the continuous x (n,) that minimises the Lagrangian, error plus price, at `multipliers` (L,)."""
        return self._level(self.prices(multipliers))

    def bend(self, x: Array, prices: Array) -> Array:
        """Return -dx / d(log price) (n,) of each quantity's minimiser x (n,) inside its bounds, at `prices` (n,)."""
        if self.of is None:
            return (x + self.x0) / (self.b + 1)
        shifted = x[self.of] + self.x0
        with np.errstate(divide="ignore", invalid="ignore"):  # quantities without gain stay at their least
            return prices / self._summed(self.a * self.b * (self.b + 1) * shifted ** (-self.b - 2))

    def _level(self, prices: Array) -> Array:
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            log_price = np.log(prices)
            if self.of is None:
                return np.clip(np.exp((self._log_gain - log_price) * self._root) - self.x0, self.low, self._useful)
            alone = np.exp((self._log_gain - log_price[self.of]) * self._root) - self.x0
            level = self.low.copy()
            np.maximum.at(level, self.of, np.minimum(alone, self._useful[self.of]))
            for _ in range(50):  # the marginal gain is convex and falls: from below, Newton never overshoots
                shifted = level[self.of] + self.x0
                gain = self.a * self.b * shifted ** (-self.b - 1)
                step = (self._summed(gain) - prices) / self._summed(gain * (self.b + 1) / shifted)
                following = np.clip(level + np.nan_to_num(step, nan=0.0), level, self._useful)
                if np.all(following - level <= 1e-13 * (level + 1)):
                    break
                level = following
            return level

    def _summed(self, values: Array) -> Array:
        return np.bincount(self.of, weights=values, minlength=len(self.low)).astype(np.float64)  # pyright: ignore[reportArgumentType]

    @cached_property
    def _columns(self) -> list[Array]:
        return [np.ascontiguousarray(column) for column in self.cost.T]

    @cached_property
    def _log_gain(self) -> Array:
        return np.log(self.a * self.b, out=np.full(len(self.a), NO_DECAY), where=self.a > 0)

    @cached_property
    def _root(self) -> Array:
        return 1 / (self.b + 1)

    @cached_property
    def _useful(self) -> Array:
        """Upper bounds (n,); a quantity without gain stays at its least, even where it costs nothing."""
        total = self.a if self.of is None else self._summed(self.a)
        return np.where(total > 0, self.high, self.low)


@dataclass(frozen=True)
class ContinuousOptimum:
    """The continuous optimum, with its multipliers and dual bound."""

    x: Array  # (n,)
    multipliers: Array  # (2,) error saved per unit of each budget
    bound: float  # the dual value: no plan within the budgets has less error


def room(problem: Separable) -> Array:
    """Return how many units of each quantity (n,) fit the budgets above `low`, while the others stay at `low`."""
    left = problem.budget * (1 + BUDGET_SLACK) - problem.spent(problem.low)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.floor(np.min(np.where(problem.cost > 0, left / problem.cost, np.inf), axis=1))


def solve_two_budgets(problem: Separable) -> ContinuousOptimum:
    """Return the continuous optimum under two budgets, by an active-set search over the binding ones.

    The sets are tried in this order: none, the scarcer budget, both, the other one.
    """
    everything = _value(problem, np.zeros(2))
    if problem.fits(everything.x):
        return everything
    scarce = int(np.argmax(problem.spent(everything.x) / problem.budget))
    other = 1 - scarce
    best = _ascend(problem, [scarce], _start(problem, [scarce]))
    if problem.fits(best.x * (1 - ALMOST)):
        return best
    start = best.multipliers.copy()
    start[other] = 0.5 * start[scarce] * problem.budget[scarce] / problem.budget[other]
    both = _ascend(problem, [0, 1], start)
    if both.multipliers[scarce] > VANISHED * start[scarce]:
        return both
    return _ascend(problem, [other], _start(problem, [other]))


def _value(problem: Separable, multipliers: Array) -> ContinuousOptimum:
    x = problem.minimise_lagrangian(multipliers)
    overspend = problem.spent(x) - problem.budget
    return ContinuousOptimum(x, multipliers, float(problem.error(x).sum() + multipliers @ overspend))


def _start(problem: Separable, binding: list[int]) -> Array:
    """Return initial multipliers (2,): the mean gain per unit of each binding budget, midway between the bounds."""
    middle = (problem.low + problem.high) / 2
    gain = problem.error(middle) / (middle + 1)
    multipliers = np.zeros(2)
    multipliers[binding] = gain.sum() / np.maximum(problem.cost[:, binding].sum(axis=0), 1e-300)
    return multipliers


def _ascend(problem: Separable, binding: list[int], start: Array) -> ContinuousOptimum:
    """Return the maximum of the dual over the multipliers of the `binding` budgets, by Newton in their logarithms."""
    now = _value(problem, start)
    overspend = (problem.spent(now.x) - problem.budget)[binding]
    for _ in range(200):
        slack = float(now.multipliers[binding] @ np.abs(overspend))
        done = np.all(overspend <= CONVERGED * problem.budget[binding]) and slack <= CONVERGED * abs(now.bound)
        if done or np.any(now.multipliers[binding] < VANISHED * start[binding]):
            break
        step = newton_step(problem, now.x, now.multipliers, binding, overspend)
        for shrink in 0.5 ** np.arange(20):
            multipliers = now.multipliers.copy()
            multipliers[binding] *= np.exp(step * shrink)
            following = _value(problem, multipliers)
            left = (problem.spent(following.x) - problem.budget)[binding]
            nearer = multipliers[binding] @ np.abs(left) < slack
            if following.bound > now.bound - nearer * ROUNDING * abs(now.bound):
                break
        else:
            break
        now = following
        overspend = left
    return now


def newton_step(
    problem: Separable, x: Array, multipliers: Array, binding: list[int], overspend: Array
) -> NDArray[np.float64]:
    """Return the Newton step of the logarithms of the binding multipliers, regularised and limited in size.

    `x` (n,) minimises the Lagrangian at `multipliers` (2,); `overspend` is the dual's gradient, per binding budget.
    """
    prices = problem.prices(multipliers)
    inside = (x > problem.low) & (x < problem.high) & (prices > 0)
    bend = problem.bend(x, prices)
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.where(inside, bend / prices, 0.0)
    cost = problem.cost[:, binding]
    scale = multipliers[binding]
    curvature = (cost * scaled[:, None]).T @ cost * np.outer(scale, scale)
    gradient = overspend * scale
    ridge = 1e-12 * max(float(np.trace(curvature)), float(np.abs(gradient).max()))
    step = np.linalg.solve(curvature + ridge * np.eye(len(binding)), gradient)
    return np.asarray(step * min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), 1e-300)), dtype=np.float64)
