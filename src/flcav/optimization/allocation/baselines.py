"""Baseline allocations without joint optimisation: equal shares, most messages, and the article's rounded optimum.

Plans are in integers and within both budgets.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from flcav.config import InputError, shorten
from flcav.geometry.arrays import Array
from flcav.network.ledger import LinkMegabytes
from flcav.optimization.allocation.allocate import (
    TaskAllocation,
    build_task_plans,
    evaluate_objective,
    name_in_tasks,
    resolve_problem,
    sum_prices,
)
from flcav.optimization.allocation.choices import settle_first
from flcav.optimization.allocation.vehicles import split_plan, trains
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.branches import solve_branches
from flcav.optimization.solvers.cutting_planes import Program, continuous_optimum
from flcav.optimization.solvers.instance import Clock, Infeasible, Instance, build_instance, own_clocks, price_once
from flcav.optimization.solvers.rounding import trim
from flcav.optimization.solvers.separable import solve_two_budgets
from flcav.optimization.solvers.weighted import list_drifts, list_terms, minimise_weighted_error

GAP = 1e-4  # relative optimality gap
LONGEST_S = 5.0  # time limit of the search for most messages
NOT_CARRIED = "its vehicles do not hold the samples for it, or their links do not carry it within horizon_s"
NOT_IN_TIME = "its vehicles do not hold the samples for it, or do not send and train it within horizon_s"


@dataclass(frozen=True)
class Baseline:
    """A baseline's plan and its predicted objective."""

    name: str  # of `BASELINES`
    objective: float  # as of `Allocation`
    tasks: tuple[TaskAllocation, ...]
    used_mb: LinkMegabytes
    note: str | None = None  # why the vehicles cannot carry it out; None: they can


def baseline(problem: Problem, name: str) -> Baseline:
    """Return the plan of `BASELINES[name]` with its predicted objective.

    Baselines call as many vehicles as allowed, have the first local steps and form of each task, and respect only the
    fleet's budgets: `note` says where the vehicles' samples or links do not suffice. Raises `Infeasible` as `allocate`
    does, and `InputError` for an unknown name.
    """
    if name not in BASELINES:
        raise InputError(f"baseline {shorten(name)}: unknown; known baselines: {', '.join(BASELINES)}")
    choices, problem = settle_first(problem)
    problem = problem.model_copy(update={"tasks": tuple(map(_call_most, problem.tasks))})
    resolved = resolve_problem(problem)
    plans = build_task_plans(problem, BASELINES[name](resolved, build_instance(resolved)))
    plans = name_in_tasks(plans, choices)
    try:
        split_plan(problem, plans)
    except Infeasible:
        note = NOT_IN_TIME if trains(problem) else NOT_CARRIED
        return Baseline(name, evaluate_objective(resolved, plans), plans, sum_prices(plans), note)
    return Baseline(name, evaluate_objective(resolved, plans), plans, sum_prices(plans))


def _call_most(task: AllocationTask) -> AllocationTask:
    return task if task.called is None else task.model_copy(update={"called": (task.called[1], task.called[1])})


def equal_stages(problem: Problem, made: Instance) -> Array:
    """Return the plan (3N,) that splits what the least plan leaves of each link equally over the stages that use it.

    Within a stage's share the tasks get the quantities of least weighted error: stage I first, then II, then III.
    """
    low, high = made.low.reshape(-1, 3), made.high.reshape(-1, 3)
    cost = made.cost.reshape(-1, 3, len(made.budget))
    uses = np.any(cost > 0, axis=0)  # (3, L)
    share = (made.budget - made.low @ made.cost) / np.maximum(uses.sum(axis=0), 1)
    x = low.copy()
    for stage in range(3):
        most = np.where(np.arange(3) == stage, high, x)
        budget = x.ravel() @ made.cost + np.where(uses[stage, :], share, 0.0)
        limited = _limited(problem, x, most, budget, own_clocks(problem))
        x = _minimise(limited).reshape(-1, 3)
    return x.ravel()


def equal_tasks(problem: Problem, made: Instance) -> Array:
    """Return the plan (3N,) that splits what the least plan leaves of each link equally over the tasks.

    Each task is then planned alone for least error within its share.
    """
    low, high = made.low.reshape(-1, 3), made.high.reshape(-1, 3)
    cost = made.cost.reshape(-1, 3, len(made.budget))
    share = (made.budget - made.low @ made.cost) / len(low)
    x, clocks = low.copy(), own_clocks(problem)  # a task alone may have fewer
    for number, task in enumerate(problem.tasks):
        alone = problem.model_copy(update={"tasks": (task,)})
        row = slice(number, number + 1)
        limited = _limited(alone, low[row], high[row], low[number] @ cost[number] + share, clocks)
        x[number] = _minimise(limited)
    return x.ravel()


def _minimise(problem: Problem) -> Array:
    """Return the plan (3N,) of least weighted error."""

    def solve(branch: Problem) -> tuple[float, Array]:
        made = build_instance(branch)
        found = minimise_weighted_error(made, GAP)
        return found.error + made.floor, found.x

    return _least(solve_branches(problem, solve))


def _least(plans: Sequence[tuple[float, Array]]) -> Array:
    """Return the plan of least error among pairs of error and plan."""
    return min(plans, key=lambda plan: plan[0])[1]


def max_throughput(problem: Problem, made: Instance) -> Array:
    """Return the plan (3N,) of maximum throughput: most messages, where a sample or a model update counts as one."""
    k = problem.edge_rounds_per_cloud_round
    groups = [task.edge_groups for task in problem.tasks]
    messages = np.array([(1, sum(sizes), len(sizes) + k * sum(sizes)) for sizes in groups], dtype=np.float64).ravel()
    found = milp(
        -messages,
        integrality=np.ones(len(messages)),
        bounds=Bounds(made.low, made.high),  # pyright: ignore[reportArgumentType]
        constraints=LinearConstraint(made.cost.T / made.budget[:, None], ub=1.0),  # pyright: ignore[reportArgumentType]
        options={"mip_rel_gap": GAP, "time_limit": LONGEST_S},
    )
    x = made.low if found.x is None else np.round(found.x)
    return trim(made, x, messages)


def round_down_optimum(problem: Problem, _made: Instance) -> Array:
    """Return the continuous optimum rounded down (3N,), the last step of the article's allocator.

    Where every cloud round costs accuracy, the optimum is that of the error's convex envelope.
    """
    return _least(solve_branches(problem, _round_down))


def _round_down(branch: Problem) -> tuple[float, Array]:
    """Return the rounded optimum of a branch, with its weighted error."""
    made = build_instance(branch)
    if made.effective is None and len(made.budget) == 2:
        x = solve_two_budgets(made.separable).x
    else:
        program = Program(list_terms(made), made.low, made.high, made.cost, made.budget, list_drifts(made))
        starts = [made.low + (made.high - made.low) * share for share in np.linspace(0, 1, 6) ** 3]
        x, _, _ = continuous_optimum(program, starts, GAP)
    x = trim(made, np.clip(np.floor(x + 1e-9), made.low, made.high), np.ones(len(x)))
    return made.error(x) + made.floor, x


def _limited(problem: Problem, low: Array, high: Array, budget: Array, clocks: Sequence[Clock]) -> Problem:
    """Return `problem` with other limits (N, 3) and budgets (L,): of the links [MB], and of `clocks` [s].

    The constant cost `price_once` is added to the wireless budget.
    """
    tasks = []
    for task, least, most in zip(problem.tasks, low, high):
        limits = {
            name: (int(a), int(b))
            for name, a, b in zip(("samples", "edge_rounds", "cloud_rounds"), least, most, strict=True)
        }
        tasks.append(task.model_copy(update={"limits": task.limits.model_copy(update=limits)}))
    limited = problem.model_copy(update={"tasks": tuple(tasks)})
    links = {"wireless": float(budget[0]) + price_once(limited), "wireline": float(budget[1])}
    budgets = problem.budgets_mb.model_copy(update=links)
    seconds: dict[str, float | None] = {
        clock.limit: float(left) for clock, left in zip(clocks, budget[2:], strict=True)
    }
    if seconds.get("horizon_s") == 0:
        seconds["horizon_s"] = None  # only before the first round
    return limited.model_copy(update={"budgets_mb": budgets, **seconds})


BASELINES: dict[str, Callable[[Problem, Instance], Array]] = {
    "equal-stages": equal_stages,
    "equal-tasks": equal_tasks,
    "max-throughput": max_throughput,
    "article": round_down_optimum,
}
