"""Max-min fairness: the plan of least largest error, with a proven lower bound over integer plans.

For an error level e, every pair of edge and cloud rounds of a task needs a least integer number of samples to keep the
task's error at or below e, and so has a least cost. At prices for which all budgets together cost 1, the sum of the
tasks' least costs is a lower bound on the price of any plan that keeps to e. Where it exceeds 1, level e is infeasible
(Lagrangian duality; Everett 1963). Bisection finds the lowest level that is not excluded; from there upwards, plans are
combined task by task until one fits the budgets. The budgets are those of both links, and limits of time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, repeat

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from flcav.geometry.arrays import Array
from flcav.optimization.curves.curves import Additive, Federated, OwnCurve, drift_part
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Instance, require_optimum
from flcav.optimization.solvers.rounding import fill
from flcav.optimization.solvers.rounds import pair_rounds
from flcav.optimization.solvers.separable import BUDGET_SLACK

MOST_MERGED = 4000  # partial plans kept while tasks are combined
PROVEN = 1e-9  # of the budgets: tolerance for rounding of sums
PLANES, PRICED = 60, 1e-9  # most cutting planes of the prices of several budgets; relative tolerance of their optimum
ROUNDING = 1e-12  # relative, of the samples needed for a level
SMALL = 1e-3  # relative change of the level in the finite difference of its price


@dataclass(frozen=True)
class Fair:
    """An integer plan with its largest error and a proven lower bound."""

    x: Array  # (n,)
    level: float  # the largest predicted error
    bound: float  # proven: no plan has a smaller largest error
    rates: Array  # (L,) decrease of the level per unit of each budget
    root: float  # the highest level that prices alone exclude, at most `bound`
    prices: Array  # (L,) per unit of each budget: at them no plan of a smaller largest error than `root` is paid


@dataclass(frozen=True)
class Choices:
    """The pairs of edge and cloud rounds of a task, and the learning curves of its members."""

    rounds: Array  # (C, 2) edge rounds, cloud rounds
    least: float  # samples
    most: float  # samples
    curves: tuple[OwnCurve, ...]
    k: int  # edge rounds per cloud round
    cost: Array  # (3, L) of one sample, edge round, cloud round under each budget

    def frontier(self, level: float) -> tuple[Array, Array]:
        """Return the Pareto-optimal counts (P, 3) that keep every curve at or below `level`, and their costs (P, L)."""
        needed = np.full(len(self.rounds), self.least)
        for curve in self.curves:
            needed = np.maximum(needed, np.ceil(_samples_for(curve, self.rounds, self.k, level) * (1 - ROUNDING)))
        kept = needed <= self.most
        counts = np.column_stack((needed[kept], self.rounds[kept]))
        cost = counts @ self.cost
        first = find_undominated(cost)
        return counts[first], cost[first]


def minimise_largest_error(problem: Problem, made: Instance, gap: float) -> Fair:
    """Return a plan whose largest error is within a relative `gap` of the least possible, where one is found.

    `made` holds `problem` in arrays. The bound is proven in any case. Raises `InputError` where the limits of a task
    leave more than `MOST_CHOICES` pairs of rounds.
    """
    tasks = _choices(problem, made)
    level = max(map(_largest, tasks, made.low.reshape(-1, 3)))
    bound = max(map(_least, tasks, made.high.reshape(-1, 3)))
    best, unreached, prices = made.low, level, np.zeros(len(made.budget))
    while unreached - bound > 0.1 * gap * bound:
        middle = 0.5 * (unreached + bound)
        choices = choose_at_level(tasks, middle, made.budget)
        if choices.out_of_reach:
            bound = middle
            prices = choices.prices
        else:
            unreached = middle
    root = bound
    tried = bound
    stride = 0.1 * gap * bound
    while level - tried > 0.1 * gap * tried:
        trial = min(0.5 * (level + tried), tried + stride)
        plan, excluded = combine_choices(choose_at_level(tasks, trial, made.budget))
        if plan is not None:
            best, level = plan.ravel(), max(map(_largest, tasks, plan))
            continue
        bound = trial if excluded and bound == tried else bound
        tried = trial
        stride = 2 * stride
    held, below = (choose_at_level(tasks, level * share, made.budget) for share in (1, 1 - SMALL))
    dearer = below.total(held.prices) - held.total(held.prices)
    rates = SMALL * level / dearer * held.prices if 0 < dearer < np.inf else np.zeros(len(made.budget))
    best = fill(made, best, made.cost @ held.prices + 1e-300)
    level = max(map(_largest, tasks, best.reshape(-1, 3)))
    return Fair(best, level, min(bound, level), rates, root, prices)


@dataclass(frozen=True)
class LevelChoices:
    """The Pareto-optimal choices of all tasks at an error level, and the link prices of the best lower bound."""

    counts: tuple[Array, ...]  # per task (P, 3)
    costs: tuple[Array, ...]  # per task (P, L)
    budget: Array  # (L,)
    prices: Array  # (L,) per unit of each budget; all budgets together cost 1
    out_of_reach: bool  # proven: no plan keeps every task at or below the level

    def total(self, prices: Array) -> float:
        """Return the sum of the tasks' least costs at `prices` (L,); infinite where a task has no choice."""
        return sum(float((cost @ prices).min()) if len(cost) else np.inf for cost in self.costs)


def choose_at_level(tasks: Sequence[Choices], level: float, budget: Array) -> LevelChoices:
    """Return the tasks' choices at an error `level`, with the prices that maximise the least total cost.

    The total cost is concave in the prices. With two budgets, bisection on its supergradient by the wireless link's
    share of the price maximises it; with more, Kelley's cutting planes do.
    """
    counts, costs = zip(*(task.frontier(level) for task in tasks))
    if not all(map(len, counts)):
        return LevelChoices(counts, costs, budget, 1 / len(budget) / budget, out_of_reach=True)
    joined = np.concatenate(costs) / budget
    starts = np.cumsum([0, *map(len, costs[:-1])])
    if len(budget) > 2:
        prices, most = _dearest_prices(joined, starts)
        return LevelChoices(counts, costs, budget, prices / budget, out_of_reach=most > 1 + PROVEN)
    task = np.repeat(np.arange(len(costs)), list(map(len, costs)))
    low, high, most, best = 0.0, 1.0, -np.inf, 0.5
    for share in chain((0.0, 1.0), repeat(None, 40)):  # the total is concave in the wireless link's share of the price
        share = 0.5 * (low + high) if share is None else share
        priced = joined @ np.array((share, 1 - share))
        least = np.minimum.reduceat(priced, starts)
        if least.sum() > most:
            most, best = float(least.sum()), share
        chosen = np.flatnonzero(priced <= least[task])
        wireless, wireline = joined[chosen[np.searchsorted(task[chosen], np.arange(len(starts)))]].sum(axis=0)
        low, high = (max(low, share), high) if wireless > wireline else (low, min(high, share))
    return LevelChoices(counts, costs, budget, np.array((best, 1 - best)) / budget, out_of_reach=most > 1 + PROVEN)


def _dearest_prices(joined: Array, starts: NDArray[np.intp]) -> tuple[Array, float]:
    """Return the prices (L,), summing to 1, that nearly maximise the least total cost, and that cost.

    `joined` (C, L) are the costs of all tasks' choices; those of a task begin at its entry of `starts` (N,).
    """
    budgets = joined.shape[1]
    prices, best, most, planes = np.full(budgets, 1 / budgets), np.full(budgets, 1 / budgets), -np.inf, []
    ends = np.r_[starts[1:], len(joined)]
    for _ in range(PLANES):
        priced = joined @ prices
        chosen = [start + int(np.argmin(priced[start:end])) for start, end in zip(starts, ends)]
        planes.append(np.r_[1.0, -joined[chosen].sum(axis=0)])
        if (total := float(priced[chosen].sum())) > most:
            most = total
            best = prices
        model = linprog(
            np.r_[-1.0, np.zeros(budgets)],
            A_ub=np.array(planes),
            b_ub=np.zeros(len(planes)),
            A_eq=np.r_[0.0, np.ones(budgets)][None],
            b_eq=[1.0],
            bounds=[(None, None), *[(0, 1)] * budgets],
        )
        upper, prices = -float(model.fun), require_optimum(model)[1:]
        if upper - most <= PRICED * max(most, 1e-300) or most > 1 + PROVEN or upper <= 1:
            break
    return best, most


def combine_choices(held: LevelChoices) -> tuple[NDArray[np.float64] | None, bool]:
    """Return an integer plan (N, 3) within the budgets, or None; and whether it is proven that there is none.

    Dynamic programming over the tasks: of the partial plans only those on the Pareto front of both links' costs are
    kept. A choice that costs more above its task's least than the budgets have left is pruned.
    """
    if held.out_of_reach:
        return None, True
    allowed = held.budget * (1 + BUDGET_SLACK)
    least = np.array([cost.min(axis=0) for cost in held.costs])
    prices = [cost @ held.prices - (cost @ held.prices).min() for cost in held.costs]
    spare = 1 - held.total(held.prices) + 2 * PROVEN
    sums, extra, exact = np.zeros((1, len(held.budget))), np.zeros(1), True
    trail: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = []  # per task: which earlier sum, which choice
    for number, (cost, above) in enumerate(zip(held.costs, prices)):
        usable = np.flatnonzero(above <= spare)
        total = (sums[:, None] + cost[usable]).reshape(-1, cost.shape[1])
        more = (extra[:, None] + above[usable]).ravel()
        kept = np.flatnonzero((more <= spare) & np.all(total + least[number + 1 :].sum(axis=0) <= allowed, axis=1))
        kept = kept[find_undominated(total[kept])]
        if not len(kept):
            return None, exact
        if len(kept) > MOST_MERGED:
            exact = False
            kept = kept[np.argsort(more[kept])[:MOST_MERGED]]
        sums, extra = total[kept], more[kept]
        trail.append((kept // len(usable), usable[kept % len(usable)]))
    at = int(np.argmin(extra))
    plan = []
    for (earlier, choice), counts in zip(reversed(trail), reversed(held.counts)):
        plan.append(counts[choice[at]])
        at = int(earlier[at])
    return np.array(plan[::-1]), False


def find_undominated(cost: Array) -> NDArray[np.intp]:
    """Return the indices of the Pareto-optimal rows of `cost` (n, L), by the first column; the first of equal rows."""
    if cost.shape[1] > 2:
        left, front = np.lexsort(cost.T[::-1]), []
        while len(left):
            front.append(left[0])
            left = left[np.any(cost[left] < cost[left[0]], axis=1)]
        return np.array(front, dtype=np.intp)
    order = np.lexsort((cost[:, 1], cost[:, 0]))
    second = cost[order, 1]
    before = np.minimum.accumulate(np.r_[np.inf, second[:-1]]) if len(order) else second
    return order[second < before]


def _choices(problem: Problem, made: Instance) -> list[Choices]:
    low, high, cost = made.low.reshape(-1, 3), made.high.reshape(-1, 3), made.cost.reshape(-1, 3, len(made.budget))
    choices = []
    for task, least, most, unit in zip(problem.tasks, low, high, cost):
        rounds = pair_rounds(least, most, "objective 'max-min'", task.name)
        curves = tuple(learner.curve for learner in task.learners)
        choices.append(Choices(rounds, least[0], most[0], curves, problem.edge_rounds_per_cloud_round, unit))
    return choices


def _largest(task: Choices, counts: Array) -> float:
    return max(float(curve.error(*counts, k=task.k)) for curve in task.curves)


def _least(task: Choices, counts: Array) -> float:
    """Return a lower bound on the task's error in any plan; `counts` (3,) are the most of its quantities.

    It is the error there, except where rounds may cost accuracy: then the least over all choices of rounds.
    """
    if not any(isinstance(curve, Federated) and curve.drift > 0 for curve in task.curves):
        return _largest(task, counts)
    (curve,) = task.curves
    return float(curve.error(counts[0], *task.rounds.T, k=task.k).min())


def _samples_for(curve: OwnCurve, rounds: Array, k: int, level: float) -> Array:
    """Return the real number of samples (C,) that brings the error after `rounds` (C, 2) to `level`; else infinite."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        if not isinstance(curve, Additive):
            left = level - curve.floor
            if isinstance(curve, Federated):
                left = left - drift_part(rounds[:, 1], curve.drift)
            needed = (np.maximum(left, 0.0) / curve.a) ** (-1 / curve.b)
            return (needed - curve.effective_samples(0, rounds[:, 0], rounds[:, 1], k)) / curve.alpha
        left = level - curve.floor - curve.edge.at(rounds[:, 0]) - curve.cloud.at(rounds[:, 1])
        if curve.pretrain.a == 0:
            return np.where(left >= 0, 0.0, np.inf)
        return np.where(left > 0, (left / curve.pretrain.a) ** (-1 / curve.pretrain.b) - curve.pretrain.x0, np.inf)
