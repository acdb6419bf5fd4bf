"""Least weighted error over integer plans, with a proven lower bound.

Minimising the Lagrangian over integer quantities gives the bound. The quantities at the best multipliers, trimmed and
filled to the budgets, are nearly optimal where tasks are many. Where they are few, quantities that no plan better than
the incumbent can have are excluded (Lagrangian bound tightening), and outer approximation over the rest
(`cutting_planes`) closes the gap. The convex terms of the error and their cuts are `PowerTerm` and `EffectiveTerm`; a
drift that costs accuracy is concave, and tabulated as `DriftTerm`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from flcav.geometry.arrays import Array
from flcav.optimization.curves.curves import drift_part, effective_samples
from flcav.optimization.solvers.cutting_planes import Line, Program, Term, outer_approximation
from flcav.optimization.solvers.effective import EffectiveTasks
from flcav.optimization.solvers.instance import Instance, require_optimum
from flcav.optimization.solvers.rounding import fill, trim
from flcav.optimization.solvers.separable import newton_step, solve_two_budgets

CORRECTIONS = 6  # Newton steps of the multipliers over integer quantities; dual points tried
PLANES = 60  # most cutting planes of the dual
DUAL_GAP = 1e-5  # least gap to which the dual is solved: outer approximation closes what is left


@dataclass(frozen=True)
class PowerTerm:
    """The inverse power a * (x[index] + x0)^(-b); its cuts are secants between neighbouring integers."""

    index: int
    a: float  # weight included
    b: float
    x0: float

    def value(self, x: Array) -> float:
        """Return the value of the term at x (n,)."""
        return self._at(x[self.index])

    def lines(self, x: Array) -> list[Line]:
        """Return the secants through the integers next to x (n,)."""
        below = np.floor(x[self.index] + 1e-9)
        starts = {below} if x[self.index] - below > 1e-6 else {below, below - 1}
        lines = []
        for start in starts:
            if start + self.x0 > 0:
                slope = self._at(start + 1) - self._at(start)
                lines.append(Line((self.index,), (slope,), self._at(start) - slope * start))
        return lines

    def _at(self, x: float) -> float:
        return float(self.a * (x + self.x0) ** -self.b)


@dataclass(frozen=True)
class EffectiveTerm:
    """The inverse power gain * n^(-b) of effective samples n; its cuts are tangents.

    n = alpha s + own (1 - 1 / (p t + 1)) + others (1 - 1 / (p z + 1)), for s = x[first] samples, z = x[first + 2] cloud
    rounds, t = x[first + 1] + k z rounds and the pace p.
    """

    first: int
    gain: float  # weight * a
    b: float
    alpha: float
    own: float  # worth of the samples held in the task's region
    others: float  # worth of the samples held in the other regions
    pace: float  # rounds of the history that one is worth
    k: int  # edge rounds per cloud round

    def value(self, x: Array) -> float:
        """Return the value of the term at x (n,)."""
        samples, edge_rounds, cloud_rounds = x[self.first : self.first + 3]
        return self.gain * self._effective(samples, edge_rounds + self.k * cloud_rounds, cloud_rounds) ** -self.b

    def lines(self, x: Array) -> list[Line]:
        """Return the tangent at x (n,)."""
        samples, edge_rounds, cloud_rounds = x[self.first : self.first + 3]
        t = edge_rounds + self.k * cloud_rounds
        per_round = self.pace * self.own / (self.pace * t + 1) ** 2
        per_cloud_round = self.k * per_round + self.pace * self.others / (self.pace * cloud_rounds + 1) ** 2
        fall = self.gain * self.b * self._effective(samples, t, cloud_rounds) ** (-self.b - 1)
        slope = -fall * np.array((self.alpha, per_round, per_cloud_round))
        index = (self.first, self.first + 1, self.first + 2)
        return [Line(index, tuple(map(float, slope)), self.value(x) - float(slope @ x[self.first : self.first + 3]))]

    def _effective(self, samples: float, t: float, cloud_rounds: float) -> float:
        held = effective_samples(samples, self.pace * t, self.alpha, self.own)
        return float(effective_samples(held, self.pace * cloud_rounds, 1.0, self.others))


@dataclass(frozen=True)
class DriftTerm:
    """The drift part of x[index] cloud rounds that cost accuracy: drift (1 - 1 / (z + 1)), concave in z."""

    index: int
    drift: float  # weight * drift, > 0

    def at(self, quantity: Array) -> Array:
        """Return the values of the term (m,) where the quantity is `quantity` (m,)."""
        return drift_part(quantity, self.drift)


def list_terms(instance: Instance) -> list[Term]:
    """Return the convex terms of the weighted error above the floors; together with `list_drifts` they add up to it."""
    powers = instance.separable
    effective = instance.effective
    of = np.arange(len(powers.a)) if powers.of is None else powers.of
    rows = zip(of.tolist(), powers.a.tolist(), powers.b.tolist(), powers.x0.tolist())
    terms: list[Term] = [PowerTerm(*row) for row in rows if row[1] > 0]
    if effective is not None:
        worth = (effective.gain, effective.b, effective.alpha, effective.own, effective.others, effective.pace)
        own = zip(*(column[:, 0].tolist() for column in (effective.quantity, *worth)))
        terms += [EffectiveTerm(*row, k=effective.k) for row in own]
        terms += [PowerTerm(index, -drift, 1.0, 1.0) for index, drift in _drifts(effective) if drift < 0]
    return terms


def list_drifts(instance: Instance) -> list[DriftTerm]:
    """Return the concave terms of the weighted error: the drift of every task whose cloud rounds cost accuracy."""
    if instance.effective is None:
        return []
    return [DriftTerm(index, drift) for index, drift in _drifts(instance.effective) if drift > 0]


def _drifts(effective: EffectiveTasks) -> list[tuple[int, float]]:
    return list(zip(effective.quantity[:, 2].tolist(), effective.drift[:, 0].tolist()))


@dataclass(frozen=True)
class Solution:
    """An integer plan with its weighted error and a proven lower bound."""

    x: Array  # (n,)
    error: float  # above the floors
    bound: float  # above the floors: no whole plan within the budgets has less
    multipliers: Array  # (L,) for which the bound is proven
    rates: Array  # (L,) decrease of the error per unit more of each budget, of the continuous or dual problem

    def gap(self, floor: float) -> float:
        """Return the relative gap (error - bound) / bound, with `floor` added to both; for a bound of 0, 0 or 1."""
        bound = min(self.bound, self.error) + floor
        if bound > 0:
            return (self.error + floor - bound) / bound
        return float(self.error > self.bound)


def minimise_weighted_error(instance: Instance, gap: float) -> Solution:
    """Return an integer plan whose weighted error is within a relative `gap` of the least, or the best found.

    Raises `InputError` where HiGHS fails.
    """
    none = np.zeros(len(instance.budget))
    best = Solution(instance.low, instance.error(instance.low), -np.inf, none, none)
    bound_at = best.multipliers
    for number, (multipliers, bound) in enumerate(_multipliers(instance, gap)):
        x, proven = instance.minimise_lagrangian(multipliers)
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
    """Yield multipliers (L,) near the dual optimum, with the lower bound known there (-inf where there is none).

    The first are those of the continuous optimum, unless a curve is over effective samples or time is limited.
    """
    if instance.effective is not None or len(instance.budget) > 2:
        yield from _planes(instance, gap)
        return
    problem = instance.separable
    relaxed = solve_two_budgets(problem)
    multipliers = relaxed.multipliers
    yield multipliers, relaxed.bound
    binding = [int(link) for link in np.flatnonzero(multipliers > 0)]
    for _ in range(CORRECTIONS if binding else 0):
        x, _ = instance.minimise_lagrangian(multipliers)
        overspend = (problem.spent(x) - problem.budget)[binding]
        step = newton_step(problem, problem.minimise_lagrangian(multipliers), multipliers, binding, overspend)
        multipliers = multipliers.copy()
        multipliers[binding] *= np.exp(np.clip(step, -0.1, 0.1))
        yield multipliers, -np.inf


def _planes(instance: Instance, gap: float) -> Iterator[tuple[Array, float]]:
    """Yield the best multipliers of Kelley's cutting-plane method on the dual over integer plans, with their bounds."""
    left = instance.budget - instance.low @ instance.cost
    largest = instance.error(instance.low) / np.maximum(left, 1e-9 * instance.budget)
    aim = np.r_[-1.0, np.zeros(len(largest))]
    within = Bounds(np.r_[-np.inf, np.zeros(len(largest))], np.r_[np.inf, np.ones(len(largest))])  # pyright: ignore
    rows, values, proven = [], [], []
    multipliers = [0.01 * largest]
    for _ in range(PLANES):
        x, bound = instance.minimise_lagrangian(multipliers[-1])
        proven.append(bound)
        rows.append(np.r_[1.0, (instance.budget - x @ instance.cost) * largest])
        values.append(instance.error(x))
        model = milp(aim, bounds=within, constraints=LinearConstraint(np.array(rows), ub=np.array(values)))  # pyright: ignore
        weights = require_optimum(model)[1:]
        if -model.fun - max(proven) <= 0.02 * max(gap, DUAL_GAP) * (max(proven) + instance.floor):
            break
        multipliers.append(weights * largest)
    order = np.argsort(-np.array(proven))
    yield from ((multipliers[i], proven[i]) for i in islice(order, CORRECTIONS))


def _closed(instance: Instance, best: Solution, gap: float) -> Solution:
    """Return `best` or a better plan, with its bound, by outer approximation within the tightened bounds."""
    _, bound = instance.minimise_lagrangian(best.multipliers)
    low, high = instance.tighten_bounds(best.multipliers, (best.error - bound) * (1 + 1e-9) + 1e-15)
    program = Program(list_terms(instance), low, high, instance.cost, instance.budget, list_drifts(instance))
    starts = [np.minimum(low + step, high) for step in range(int(min((high - low).max(), 40)) + 1)]
    starts += [np.floor(low + (high - low) * share) for share in np.linspace(0, 1, 9)]
    visited, proven = outer_approximation(program, [*starts, np.clip(best.x, low, high)], gap, instance.floor)
    prices = instance.separable.prices(best.multipliers) + 1e-300
    points = [best.x, *(fill(instance, trim(instance, x, prices), prices) for x in visited)]
    errors = [instance.error(x) for x in points]
    first = int(np.argmin(errors))
    bound = max(best.bound, min(proven, best.error))
    return Solution(points[first], errors[first], bound, best.multipliers, best.rates)
