"""Least weighted error over whole plans, with a proven bound.

The dual over whole quantities gives the bound; the quantities at its multipliers, trimmed and filled, are nearly
optimal where tasks are many. Where they are few, every quantity that would cost more than the gap is cut away, and an
exact program over the few that are left (`cutting_planes`) closes it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from flcav.optimization.cutting_planes import Program, outer_approximation
from flcav.optimization.instance import Instance, variables
from flcav.optimization.rounding import fill, trim
from flcav.optimization.separable import Separable, newton_step, relax
from flcav.optimization.terms import terms_of

Array = NDArray[np.float64]

CORRECTIONS = 6  # of the multipliers, towards whole quantities that spend the budgets
PLANES = 60  # of the dual


@dataclass(frozen=True)
class Solution:
    """Whole quantities and what is proven about them."""

    x: Array  # (n,)
    error: float  # above the floors
    bound: float  # above the floors: no whole quantities within the budgets have less
    multipliers: Array  # (2,) at which the bound is proven
    rates: Array  # (2,) error saved per MB more of each link, before rounding to whole quantities

    def gap(self, floor: float) -> float:
        """Return (error - bound) / bound, both with `floor`."""
        bound = min(self.bound, self.error) + floor
        if bound > 0:
            return (self.error + floor - bound) / bound
        return float(self.error > self.bound)


def whole_plan(problem: Separable, gap: float = 1e-4) -> Solution:
    """Return whole quantities of `problem` within a relative `gap` of the least error: on arrays, without any task."""
    return least_weighted(Instance(problem, None, 0.0), gap)


def least_weighted(instance: Instance, gap: float) -> Solution:
    """Return whole quantities within a relative `gap` of the least error."""
    best = Solution(instance.low, instance.error(instance.low), -np.inf, np.zeros(2), np.zeros(2))
    bound_at = best.multipliers
    for number, (multipliers, bound) in enumerate(_multipliers(instance, gap)):
        x, proven = instance.cheapest(multipliers)
        if max(proven, bound) > best.bound:
            bound_at = multipliers
        prices = instance.separable.prices(multipliers + 1e-9 * multipliers.sum() + 1e-300)
        x = fill(instance, trim(instance, x, prices), prices)
        error = instance.error(x)
        best = Solution(
            *((x, error) if error < best.error else (best.x, best.error)),
            bound=max(best.bound, proven, bound),
            multipliers=bound_at,
            rates=best.rates if number else multipliers,
        )
        if best.gap(instance.floor) <= gap:
            return best
    return _closed(instance, best, gap)


def _multipliers(instance: Instance, gap: float) -> Iterator[tuple[Array, float]]:
    """Yield multipliers near the best, and the bound that is known there; first those of the fractional optimum."""
    if instance.effective is not None:
        yield from _planes(instance, gap)
        return
    problem = instance.separable
    relaxed = relax(problem)
    multipliers = relaxed.multipliers
    yield multipliers, relaxed.bound
    binding = [int(link) for link in np.flatnonzero(multipliers > 0)]
    for _ in range(CORRECTIONS if binding else 0):
        x, _ = instance.cheapest(multipliers)
        overspend = (problem.spent(x) - problem.budget)[binding]
        step = newton_step(problem, problem.cheapest(multipliers), multipliers, binding, overspend)
        multipliers = multipliers.copy()
        multipliers[binding] *= np.exp(np.clip(step, -0.1, 0.1))
        yield multipliers, -np.inf


def _planes(instance: Instance, gap: float) -> Iterator[tuple[Array, float]]:
    """Yield the best few of the multipliers that Kelley's cutting planes try on the dual over whole quantities."""
    left = instance.budget - instance.low @ instance.cost
    largest = instance.error(instance.low) / np.maximum(left, 1e-9 * instance.budget)
    rows, values, proven = [], [], []
    multipliers = [0.01 * largest]
    for _ in range(PLANES):
        x, bound = instance.cheapest(multipliers[-1])
        proven.append(bound)
        rows.append(np.r_[1.0, (instance.budget - x @ instance.cost) * largest])
        values.append(instance.error(x))
        model = linprog([-1.0, 0, 0], A_ub=np.array(rows), b_ub=values, bounds=[(None, None), (0, 1), (0, 1)])
        weights = variables(model)[1:]
        if -model.fun - max(proven) <= 0.02 * gap * (max(proven) + instance.floor):
            break
        multipliers.append(weights * largest)
    order = np.argsort(-np.array(proven))
    yield from ((multipliers[i], proven[i]) for i in islice(order, CORRECTIONS))


def _closed(instance: Instance, best: Solution, gap: float) -> Solution:
    """Return `best` or better, within `gap`, by an exact program over what can still be in an optimal plan."""
    _, bound = instance.cheapest(best.multipliers)
    low, high = instance.narrowed(best.multipliers, (best.error - bound) * (1 + 1e-9) + 1e-15)
    program = Program(terms_of(instance), low, high, instance.cost, instance.budget)
    starts = [np.minimum(low + step, high) for step in range(int(min((high - low).max(), 40)) + 1)]
    starts += [np.floor(low + (high - low) * share) for share in np.linspace(0, 1, 9)]
    visited, proven = outer_approximation(program, [*starts, np.clip(best.x, low, high)], gap, instance.floor)
    prices = instance.separable.prices(best.multipliers) + 1e-300
    points = [best.x, *(fill(instance, trim(instance, x, prices), prices) for x in visited)]
    errors = [instance.error(x) for x in points]
    first = int(np.argmin(errors))
    bound = max(best.bound, min(proven, best.error))
    return Solution(points[first], errors[first], bound, best.multipliers, best.rates)
