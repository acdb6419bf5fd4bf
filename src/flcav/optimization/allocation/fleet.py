"""Allocation under the fleet budgets and the limits of each vehicle: samples held, and link capacity within a horizon.

The budgets constrain the fleet as a whole, and the optimum within them may ask more of slow links than `horizon_s`
allows. Then two relaxations are solved, each with one budget reduced by bisection until the plan can be split over the
vehicles (`split_plan`):

- *all join*: every vehicle joins every round, as the budgets are priced; the wireless budget is reduced.
- *one joins*: one vehicle per edge group joins each round, the least that a split needs; the wireless budget is
  replaced by what all links together carry within the horizon, and that is reduced.

At full size each relaxation is a lower bound of the error of any feasible plan; the larger of the two bounds is kept.
The better of the two plans is returned, with its gap to that bound.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flcav.network.plan import Price
from flcav.optimization.allocation.allocate import (
    Allocation,
    allocate,
    build_task_plans,
    evaluate_objective,
    relative_gap,
    resolve_problem,
    sum_prices,
)
from flcav.optimization.allocation.vehicles import BITS_PER_BYTE, Shares, TooSlow, split_plan
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.instance import Infeasible

HALVINGS = 9  # steps of the bisection over the share of a budget
ROUNDING = 1e-9  # relative tolerance of budgets and objectives
OPTIMAL = 1e-4  # largest gap of a plan that is called optimal
CARRIED = "the vehicles' own links, within horizon_s, limit this plan"

Carried = tuple[Allocation, Shares]  # a plan and its split over the vehicles
Relaxation = Callable[[float], Problem]  # the relaxation by the share of its budget, 0 to 1


def allocate_fleet(problem: Problem) -> Carried:
    """Return the best plan that the vehicles can carry out, and each vehicle's share of it, by task.

    Tasks that do not name their vehicles are planned under the budgets alone and have no shares. Raises `Infeasible`
    where the limits ask for more than the budgets or the samples held, and `TooSlow` where no plan fits the links.
    """
    asked = problem.model_copy(update={"tasks": tuple(_within_held(task) for task in problem.tasks)})
    plan = allocate(asked)
    try:
        return plan, split_plan(asked, plan.tasks)
    except TooSlow as error:
        relaxations, bounds = [_all_join(asked, plan)], [plan.lower_bound]
        if all(task.uplink_mbps for task in asked.tasks):
            relaxations.insert(0, _one_joins(asked))
            bounds.append(_bound(relaxations[0]))
        lower = max((bound for bound in bounds if bound is not None), default=None)
        found: list[Carried] = []
        for relaxed in relaxations:
            if carried := _largest(asked, relaxed):
                found.append(carried)
                if lower is not None and carried[0].objective <= lower * (1 + ROUNDING):
                    break  # no plan is better
        if not found:
            raise error
        return _certified(asked, found, lower)


def _within_held(task: AllocationTask) -> AllocationTask:
    """Return the task with its upper limit of samples at most what its vehicles hold.

    Raises `Infeasible` if its lower limit is more.
    """
    vehicles = task.uplink_mbps or {}
    if not vehicles or any(vehicle not in task.samples_held for vehicle in vehicles):
        return task
    held = sum(task.samples_held[vehicle] for vehicle in vehicles)
    least, most = task.limits.samples
    if held < least:
        raise Infeasible(
            f"task {task.name!r}: its vehicles hold {held} samples (samples_held), and limits.samples starts at {least}"
        )
    limits = task.limits.model_copy(update={"samples": (least, min(most, held))})
    return task.model_copy(update={"limits": limits})


def _all_join(asked: Problem, plan: Allocation) -> Relaxation:
    return lambda share: _with_wireless(asked, share * plan.used_mb.wireless_mb, asked.tasks)


def _one_joins(asked: Problem) -> Relaxation:
    assert asked.horizon_s is not None
    links = {name: link.wireless for task in asked.tasks for name, link in (task.uplink_mbps or {}).items()}
    carried_mb = min(sum(links.values()) * asked.horizon_s / BITS_PER_BYTE, asked.budgets_mb.wireless)
    tasks = tuple(task.model_copy(update={"edge_groups": (1,) * len(task.edge_groups)}) for task in asked.tasks)
    return lambda share: _with_wireless(asked, share * carried_mb, tasks)


def _with_wireless(asked: Problem, wireless_mb: float, tasks: tuple[AllocationTask, ...]) -> Problem:
    budgets = asked.budgets_mb.model_copy(update={"wireless": wireless_mb})
    return asked.model_copy(update={"budgets_mb": budgets, "tasks": tasks})


def _largest(asked: Problem, relaxed: Relaxation) -> Carried | None:
    """Return the plan of the largest share of the budget that can be carried, by bisection; None if none was found."""
    low, high, share, found = 0.0, 1.0, 1.0, None
    for _ in range(HALVINGS + 1):
        try:
            found, low = _carried(asked, allocate(relaxed(share))), share
        except TooSlow:
            high = share
        except Infeasible:
            low = share  # too little for the limits
        if low >= high:
            break
        share = (low + high) / 2
    return found


def _carried(asked: Problem, plan: Allocation) -> Carried:
    """Return the plan priced in `asked` and split over the vehicles; raises `TooSlow` beyond the links or budgets."""
    counts = [count for row in plan.tasks for count in (row.samples, row.edge_rounds, row.cloud_rounds)]
    tasks = build_task_plans(asked, np.array(counts, dtype=np.float64))
    spent = sum_prices(tasks)
    if spent.wireless_mb > asked.budgets_mb.wireless * (1 + ROUNDING):
        raise TooSlow("the wireless budget does not carry the rounds of every vehicle")
    shares = split_plan(asked, tasks)
    return replace(
        plan, tasks=tasks, used_mb=spent, objective=evaluate_objective(resolve_problem(asked), tasks)
    ), shares


def _bound(relaxed: Relaxation) -> float | None:
    try:
        return allocate(relaxed(1.0)).lower_bound
    except Infeasible:
        return None


def _certified(asked: Problem, found: Sequence[Carried], bound: float | None) -> Carried:
    """Return the best plan with its certificate; its derivative by the wireless budget is not known and set to 0."""
    larger = asked.objective == "area"
    plan, shares = (max if larger else min)(found, key=lambda carried: carried[0].objective)
    lower = None if bound is None else min(bound, plan.objective)
    gap = None if lower is None else relative_gap(plan.objective, lower)
    rates = Price(0.0, plan.marginal_error_per_gb.wireline_mb)
    notes = (plan.note, CARRIED)
    certified = replace(
        plan,
        status="optimal" if gap is not None and gap <= OPTIMAL else "feasible",
        lower_bound=lower,
        gap=gap,
        marginal_error_per_gb=rates,
        note="; ".join(note for note in notes if note),
    )
    return certified, shares
