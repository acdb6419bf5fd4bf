"""MLGRA: how many samples, edge rounds and cloud rounds each task gets, under both uplink budgets, to err least.

The whole-number plan comes with a proven lower bound. Additive curves go through the dual of `separable`; what that
leaves open, and effective-samples curves, through `cutting_planes`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.network.plan import MessageSizes, Price, StagePlan, price
from flcav.optimization.curves import Additive, Effective
from flcav.optimization.cutting_planes import Line, Program, Term, outer_approximation
from flcav.optimization.problem import Problem, Task
from flcav.optimization.separable import BUDGET_SLACK, Separable, fill, relax, round_down, whole_bound

Array = NDArray[np.float64]

MB_PER_GB = 1000.0


class Infeasible(InputError):
    """Even the least plan that the limits allow costs more than a budget."""


@dataclass(frozen=True)
class TaskPlan:
    """What one task gets."""

    name: str
    samples: int
    edge_rounds: int
    cloud_rounds: int
    predicted_error: float
    wireless_mb: float
    wireline_mb: float


@dataclass(frozen=True)
class Allocation:
    """A plan for all tasks and its certificate."""

    status: str  # optimal: within the gap asked for; feasible: the gap is wider
    objective: float  # weighted sum of the predicted errors
    lower_bound: float  # proven: no plan has less
    gap: float  # (objective - lower_bound) / lower_bound
    tasks: tuple[TaskPlan, ...]
    used_mb: Price
    marginal_error_per_gb: Price  # rate at which 1000 MB more on a link would lower the relaxed objective


def allocate(problem: Problem, *, gap: float = 1e-4) -> Allocation:
    """Return the plan of least weighted error within both budgets, proven to a relative `gap` (one task: to 1e-9).

    Raises `Infeasible`, naming the budget, the least that the limits allow, and by how much that is over.
    """
    bounds = _bounds(problem)
    gap = gap if len(problem.tasks) > 1 else min(gap, 1e-9)
    x, lower, multipliers = _solve(problem, *bounds, gap)
    plans = tuple(_task_plan(problem, task, row) for task, row in zip(problem.tasks, x.reshape(-1, 3)))
    objective = sum(task.weight * plan.predicted_error for task, plan in zip(problem.tasks, plans))
    lower = min(lower, objective)
    achieved = (objective - lower) / lower if lower > 0 else float(objective > 0)
    return Allocation(
        status="optimal" if achieved <= gap else "feasible",
        objective=objective,
        lower_bound=lower,
        gap=achieved,
        tasks=plans,
        used_mb=Price(sum(plan.wireless_mb for plan in plans), sum(plan.wireline_mb for plan in plans)),
        marginal_error_per_gb=Price(*(MB_PER_GB * max(float(rate), 0.0) for rate in multipliers)),
    )


def stage_plan(problem: Problem, task: Task, counts: Sequence[int]) -> StagePlan:
    """Return the plan of `task` with `counts` = samples, edge rounds, cloud rounds."""
    samples, edge_rounds, cloud_rounds = counts
    return StagePlan(samples, edge_rounds, cloud_rounds, task.edge_groups, problem.edge_rounds_per_cloud_round)


def _cost(problem: Problem, task: Task, counts: Sequence[int]) -> Price:
    return price(stage_plan(problem, task, counts), MessageSizes(task.sample_mb, task.model_mb))


def _task_plan(problem: Problem, task: Task, row: Array) -> TaskPlan:
    samples, edge_rounds, cloud_rounds = (int(count) for count in row)
    error = float(task.curve.error(samples, edge_rounds, cloud_rounds, problem.edge_rounds_per_cloud_round))
    cost = _cost(problem, task, (samples, edge_rounds, cloud_rounds))
    return TaskPlan(task.name, samples, edge_rounds, cloud_rounds, error, cost.wireless_mb, cost.wireline_mb)


def _unit_costs(problem: Problem) -> Array:
    """Return the (3N, 2) cost of one sample, edge round and cloud round of each task: `price` is linear."""
    prices = [_cost(problem, task, unit) for task in problem.tasks for unit in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    return np.array([(each.wireless_mb, each.wireline_mb) for each in prices])


def _bounds(problem: Problem) -> tuple[Array, Array, Array, Array]:
    """Return low (3N,), high (3N,), cost (3N, 2) and budget (2,); raises `Infeasible`."""
    low, high = [], []
    for task in problem.tasks:
        limits = task.limits
        ranges = np.array((limits.samples, limits.edge_rounds, limits.cloud_rounds), dtype=np.float64)
        if isinstance(task.curve, Additive):  # an infinite error is never chosen
            ranges[:, 0] = np.maximum(ranges[:, 0], [decay.infinite_at_0 for decay in task.curve.decays()])
        if problem.edge_rounds_per_cloud_round == 0:
            ranges[2, 1] = min(ranges[2, 1], 1)
        low.append(ranges[:, 0])
        high.append(ranges[:, 1])
    least, most = np.concatenate(low), np.concatenate(high)
    cost = _unit_costs(problem)
    budget = np.array((problem.budgets_mb.wireless, problem.budgets_mb.wireline))
    needed = least @ cost
    for link, need, have in zip(("wireless", "wireline"), needed, budget):
        if need > have * (1 + BUDGET_SLACK):
            raise Infeasible(
                f"the least that the limits allow costs {need:.6g} MB of {link} uplink, {need - have:.6g} MB more than "
                f"budgets_mb.{link} = {have:.6g}"
            )
    left = budget * (1 + BUDGET_SLACK) - needed
    with np.errstate(divide="ignore"):
        room = np.floor(np.min(np.where(cost > 0, left / cost, np.inf), axis=1))
    return least, np.minimum(most, least + room), cost, budget


def _solve(
    problem: Problem, low: Array, high: Array, cost: Array, budget: Array, gap: float
) -> tuple[Array, float, Array]:
    """Return whole x (3N,) within the budgets, a proven lower bound and the (2,) multipliers per MB."""
    floor = sum(task.weight * task.curve.floor for task in problem.tasks)
    program = Program(_terms(problem), low, high, cost, budget)
    starts = [np.floor(low + (high - low) * share) for share in (0, 0.003, 0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1)]
    if all(isinstance(task.curve, Additive) for task in problem.tasks):
        separable = _separable(problem, low, high, cost, budget)
        relaxed = relax(separable)
        best = round_down(separable, relaxed)
        bound = max(relaxed.bound, whole_bound(separable, relaxed.multipliers))
        if program.value(best) - bound <= gap * (bound + floor):
            return best, floor + bound, relaxed.multipliers
        visited, proven, _ = outer_approximation(program, [*starts, best, relaxed.x], gap)
        prices = cost @ relaxed.multipliers + 1e-300
        candidates = [best, *(fill(separable, _trimmed(program, x), prices) for x in visited)]
        return min(candidates, key=program.value), floor + max(bound, proven), relaxed.multipliers
    visited, bound, multipliers = outer_approximation(program, starts, gap)
    return min((_trimmed(program, x) for x in visited), key=program.value), floor + bound, multipliers


def _trimmed(program: Program, x: Array) -> Array:
    """Return x with units taken back, the cheapest loss first, until it is within the budgets exactly."""
    x = x.copy()
    while np.any(over := x @ program.cost > program.budget * (1 + BUDGET_SLACK)):
        useful = np.flatnonzero((x > program.low) & (program.cost[:, over].sum(axis=1) > 0))
        losses = [program.value(x - (np.arange(len(x)) == j)) for j in useful]
        x[useful[int(np.argmin(losses))]] -= 1
    return x


def _separable(problem: Problem, low: Array, high: Array, cost: Array, budget: Array) -> Separable:
    rows = [
        (task.weight * decay.a, decay.b, decay.x0 if decay.a > 0 else 1.0)
        for task in problem.tasks
        if isinstance(task.curve, Additive)
        for decay in task.curve.decays()
    ]
    a, b, x0 = np.array(rows).T
    return Separable(a, b, x0, low, high, cost, budget)


@dataclass(frozen=True)
class _Power:
    """weight * a * (x[index] + x0)^(-b)."""

    index: int
    a: float
    b: float
    x0: float

    def value(self, x: Array) -> float:
        return self._at(x[self.index])

    def lines(self, x: Array) -> list[Line]:
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
class _EffectiveError:
    """The weighted error above its floor of one task, of x[first : first + 3]; its lines are tangents."""

    first: int
    weight: float
    curve: Effective
    k: int

    def value(self, x: Array) -> float:
        samples, edge_rounds, cloud_rounds = x[self.first : self.first + 3]
        return self.weight * float(self.curve.error(samples, edge_rounds, cloud_rounds, self.k) - self.curve.floor)

    def lines(self, x: Array) -> list[Line]:
        counts, curve = x[self.first : self.first + 3], self.curve
        effective = float(curve.effective_samples(counts[0], counts[1], counts[2], self.k))
        per_round = curve.beta * curve.group_samples / (counts[1] + self.k * counts[2] + 1) ** 2
        gain = self.weight * curve.a * curve.b * effective ** (-curve.b - 1)
        slope = -gain * np.array((curve.alpha, per_round, self.k * per_round))
        index = (self.first, self.first + 1, self.first + 2)
        return [Line(index, tuple(map(float, slope)), self.value(x) - float(slope @ counts))]


def _terms(problem: Problem) -> list[Term]:
    terms: list[Term] = []
    for number, task in enumerate(problem.tasks):
        if isinstance(task.curve, Effective):
            terms.append(_EffectiveError(3 * number, task.weight, task.curve, problem.edge_rounds_per_cloud_round))
            continue
        for stage, decay in enumerate(task.curve.decays()):
            if decay.a > 0:
                terms.append(_Power(3 * number + stage, task.weight * decay.a, decay.b, decay.x0))
    return terms
