"""An allocation problem in arrays: three quantities per task, their bounds and costs, and the resulting error."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult

from flcav.config import InputError, shorten
from flcav.geometry.arrays import Array
from flcav.network.ledger import LinkMegabytes
from flcav.network.plan import StagePlan, price
from flcav.optimization.curves.curves import Additive
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.effective import EffectiveTask, EffectiveTasks, build_effective_tasks
from flcav.optimization.solvers.rounding import outermost
from flcav.optimization.solvers.separable import BUDGET_SLACK, Separable, room


def require_optimum(result: OptimizeResult) -> Array:
    """Return the optimal variables in the result of a SciPy solver; raises `InputError` where it found none."""
    if result.x is None:
        raise InputError(f"the solver fails on numbers of such different sizes: {shorten(result.message)}")
    return result.x


class Infeasible(InputError):
    """No plan fits: even the least one exceeds a budget, the samples held, or the time of the vehicles."""


@dataclass(frozen=True)
class Clock:
    """A limit of time, which samples and rounds of N tasks consume as they consume megabytes."""

    per_sample: tuple[float, ...]  # (N,) [s]
    per_round: tuple[float, ...]  # (N,) [s] of an edge round; a cloud round is k of them
    seconds: float  # available time [s]
    limit: str = "horizon_s"  # field of the problem that limits it


def shared_clock(problem: Problem) -> Clock | None:
    """Return the limit of training time on a vehicle that joins every round of all tasks without named vehicles.

    Vehicles without names are indistinguishable, so that any of them may be that one. None where no such task has a
    `train_s`, or the problem has no `horizon_s`.
    """
    per_round = tuple(0.0 if task.vehicles else task.train_s for task in problem.tasks)
    if problem.horizon_s is None or not any(per_round):
        return None
    return Clock((0.0,) * len(per_round), per_round, problem.horizon_s)


def annotation_clock(problem: Problem) -> Clock | None:
    """Return the limit of annotators' time on the samples of all tasks; None where the problem has none."""
    if problem.annotation_s is None:
        return None
    per_sample = tuple(task.annotate_s for task in problem.tasks)
    return Clock(per_sample, (0.0,) * len(per_sample), problem.annotation_s, "annotation_s")


def own_clocks(problem: Problem) -> tuple[Clock, ...]:
    """Return the limits of time of a problem: `shared_clock`, then `annotation_clock`, as far as it has them."""
    return tuple(clock for clock in (shared_clock(problem), annotation_clock(problem)) if clock is not None)


@dataclass(frozen=True)
class Instance:
    """An allocation problem of N tasks in n = 3 N quantities.

    Quantities 3 i, 3 i + 1 and 3 i + 2 are the samples, edge rounds and cloud rounds of task i.
    """

    separable: Separable  # every additive curve, and all bounds, costs and budgets
    effective: EffectiveTasks | None  # every curve over effective samples
    floor: float  # weighted sum of the floors

    @property
    def low(self) -> Array:
        """Least of each quantity (n,)."""
        return self.separable.low

    @property
    def high(self) -> Array:
        """Most of each quantity (n,)."""
        return self.separable.high

    @property
    def cost(self) -> Array:
        """Cost of one unit of each quantity under each budget (n, L): on each link [MB], on each clock [s]."""
        return self.separable.cost

    @property
    def budget(self) -> Array:
        """Budgets (L,): of each link, wireless and wireline [MB], then of each clock [s]."""
        return self.separable.budget

    def error(self, x: Array) -> float:
        """Return the weighted error above the floors at x (n,)."""
        effective_error = 0.0 if self.effective is None else float(self.effective.error(x).sum())
        return float(self.separable.error(x).sum()) + effective_error

    def change(self, x: Array, step: int) -> Array:
        """Return the change of the weighted error (n,) when one quantity at a time changes by `step`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            change = self.separable.error(x + step) - self.separable.error(x)
            if self.effective is not None:
                before = self.effective.error(x)
                for column in self.effective.quantity.T:
                    moved = x.copy()
                    moved[column] += step
                    change[column] += self.effective.error(moved) - before
        return change

    def minimise_lagrangian(self, multipliers: Array) -> tuple[Array, float]:
        """Return the integers x (n,) of least Lagrangian at `multipliers` (L,), and the lower bound that they prove."""
        problem = self.separable
        prices = self.separable.prices(multipliers)
        below = np.floor(problem.minimise_lagrangian(multipliers))
        above = np.minimum(below + 1, problem.high)
        values = [problem.error(x) + prices * x for x in (below, above)]
        x = np.where(values[0] <= values[1], below, above)
        value = np.minimum(*values)
        total = float(value.sum())
        if self.effective is not None:
            counts, least = self.effective.minimise_lagrangian(multipliers)
            quantity = self.effective.quantity
            total += float(least.sum() - value[quantity].sum())
            x[quantity] = counts
        return x, total - float(multipliers @ problem.budget)

    def tighten_bounds(self, multipliers: Array, slack: float) -> tuple[Array, Array]:
        """Return the bounds, (n,) each, of the quantities whose error plus price is within `slack` of its minimum.

        Prices are those at `multipliers` (L,). If `slack` is the distance from the dual bound to the error of a known
        plan, no better plan has a quantity outside these bounds (Lagrangian bound tightening).
        """
        problem = self.separable
        prices = self.separable.prices(multipliers)
        best, _ = self.minimise_lagrangian(multipliers)
        limit = problem.error(best) + prices * best + slack

        def good(x: Array) -> NDArray[np.bool_]:
            return problem.error(x) + prices * x <= limit

        low, high = (outermost(good, best, edge) for edge in (problem.low, problem.high))
        if self.effective is not None:
            quantity = self.effective.quantity
            low[quantity], high[quantity] = self.effective.tighten_bounds(multipliers, slack)
        return low, high


def build_instance(problem: Problem, clocks: Sequence[Clock] = ()) -> Instance:
    """Return `problem` in arrays, its upper bounds lowered to what the budgets allow.

    The budgets are those of both links, of the problem's `shared_clock`, and of `clocks`. Raises `Infeasible`, naming
    the budget, the cost of the least plan and the excess, where the least plan exceeds a budget.
    """
    low, high = (np.concatenate(edge) for edge in zip(*(_range(problem, task) for task in problem.tasks)))
    rows: list[tuple[float, float, float, int]] = []
    alone: list[EffectiveTask] = []
    for number, task in enumerate(problem.tasks):
        for learner in task.learners:
            if not isinstance(learner.curve, Additive):
                alone.append(EffectiveTask(number, task.name, learner.weight, learner.curve))
                continue
            for stage, decay in enumerate(learner.curve.decays()):
                if decay.a > 0:
                    rows.append((learner.weight * decay.a, decay.b, decay.x0, 3 * number + stage))
    idle = np.setdiff1d(np.arange(len(low)), [row[3] for row in rows])
    rows += [(0.0, 1.0, 1.0, int(quantity)) for quantity in idle]
    a, b, x0, of = np.array(sorted(rows, key=lambda row: row[3])).T
    clocks = (*own_clocks(problem), *clocks)
    once_mb = price_once(problem)
    links = (problem.budgets_mb.wireless - once_mb, problem.budgets_mb.wireline)
    budget = np.array((*links, *(clock.seconds for clock in clocks)))
    k = problem.edge_rounds_per_cloud_round
    cost = np.column_stack((unit_costs(problem), *(_spent(clock, k) for clock in clocks)))
    powers_of = None if len(of) == len(low) else of.astype(np.intp)
    powers = Separable(a, b, x0, low, high, cost, budget, powers_of)
    _refuse(powers, once_mb, clocks)
    powers = replace(powers, high=np.minimum(high, low + room(powers)))
    effective = build_effective_tasks(alone, k, low, powers.high, powers.cost) if alone else None
    floor = sum(learner.weight * learner.curve.floor for task in problem.tasks for learner in task.learners)
    return Instance(powers, effective, floor)


def stage_plan(problem: Problem, task: AllocationTask, counts: Sequence[int]) -> StagePlan:
    """Return the plan of `task` with `counts` (samples, edge rounds, cloud rounds) and the most vehicles called."""
    samples, edge_rounds, cloud_rounds = counts
    k = problem.edge_rounds_per_cloud_round
    most = None if task.called is None else task.called[1]
    return StagePlan(samples, edge_rounds, cloud_rounds, task.edge_groups, k, most)


def price_counts(problem: Problem, task: AllocationTask, counts: Sequence[int]) -> LinkMegabytes:
    """Return the cost on each uplink [MB] of `counts` (samples, edge rounds, cloud rounds) of `task`."""
    return price(stage_plan(problem, task, counts), task.sizes)


def price_once(problem: Problem) -> float:
    """Return the wireless uplink [MB] that labels take before the first cloud round, where limits allow one."""
    return sum(
        sum(task.edge_groups) * (task.labels_mb or 0.0) for task in problem.tasks if task.limits.cloud_rounds[1] > 0
    )


def unit_costs(problem: Problem) -> Array:
    """Return the cost (3N, 2) [MB] of one sample, edge round and cloud round of each task.

    `price` is linear in the counts except for the constant `price_once`.
    """
    costs = []
    for task in problem.tasks:
        for unit in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
            sizes = task.sizes if unit[1] else replace(task.sizes, labels_mb=None)
            cost = price(stage_plan(problem, task, unit), sizes)
            costs.append((cost.wireless_mb, cost.wireline_mb))
    return np.array(costs)


def _range(problem: Problem, task: AllocationTask) -> tuple[Array, Array]:
    """Return the least and most of a task's quantities, (3,) each, without those of infinite error."""
    limits = task.limits
    ranges = np.array((limits.samples, limits.edge_rounds, limits.cloud_rounds), dtype=np.float64)
    for learner in task.learners:
        if isinstance(learner.curve, Additive):
            infinite = [decay.infinite_at_0 for decay in learner.curve.decays()]
            ranges[:, 0] = np.maximum(ranges[:, 0], infinite)
    if problem.edge_rounds_per_cloud_round == 0:
        ranges[2, 1] = min(ranges[2, 1], 1)
    return ranges[:, 0], ranges[:, 1]


def _spent(clock: Clock, k: int) -> Array:
    """Return the time (3N,) [s] that one sample, edge round and cloud round of each task take."""
    per_round = np.array(clock.per_round)
    return np.column_stack((clock.per_sample, per_round, k * per_round)).ravel()


def _refuse(problem: Separable, once_mb: float, clocks: Sequence[Clock]) -> None:
    for clock, need, have in zip(clocks, problem.spent(problem.low)[2:], problem.budget[2:], strict=True):
        if need > have * (1 + BUDGET_SLACK):
            of = "on a vehicle" if clock.limit == "horizon_s" else "of annotators"
            raise Infeasible(
                f"the least that the limits allow takes {need:.6g} s {of}, {need - have:.6g} s more than "
                f"{clock.limit} = {have:.6g}"
            )
    links = (("wireless", once_mb), ("wireline", 0.0))
    for (link, once), need, have in zip(links, problem.spent(problem.low), problem.budget):
        if need > have * (1 + BUDGET_SLACK):
            raise Infeasible(
                f"the least that the limits allow costs {need + once:.6g} MB of {link} uplink, {need - have:.6g} MB "
                f"more than budgets_mb.{link} = {have + once:.6g}"
            )
