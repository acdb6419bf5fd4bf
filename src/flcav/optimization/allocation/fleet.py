"""Allocation under the fleet budgets and the limits of every vehicle: the samples it holds, and its time in a horizon.

The budgets constrain the fleet as a whole, and the optimum within them may ask more of slow vehicles than `horizon_s`
allows. In that case relaxations are solved, with one budget reduced by bisection until the plan can be split over the
vehicles (`split_plan`). Where only sending takes time:

- *all join*: every vehicle joins every round, as the budgets are priced; the wireless budget is reduced.
- *one joins*: one vehicle per edge group joins each round, the least that a split needs; the wireless budget is
  replaced by what all links together carry within the horizon, and that is reduced.

Where vehicles also take time to train, time is the third budget (`Clock`), and is reduced:

- *all join*: the slowest vehicle joins every round; with and without the time in which the fleet sends the samples.
- *one joins*: one vehicle per edge group joins each round. The time of all vehicles, weighted by speed, is limited
  to the horizon, and no split takes less of it than the quickest vehicles by weight would.

The problem without a horizon, and *one joins* at full size, are lower bounds on the error of any feasible plan; the
larger of the two bounds is kept. The best of the plans is returned, with its gap to that bound; its `certificate` is
that of the problem without a horizon for named vehicles.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from flcav.interface.wording import plural
from flcav.network.ledger import LinkMegabytes
from flcav.optimization.allocation.allocate import (
    Allocation,
    Dual,
    allocate,
    build_task_plans,
    evaluate_objective,
    join_plans,
    name_choices,
    relative_gap,
    resolve_problem,
    sum_prices,
)
from flcav.optimization.allocation.choices import list_settled
from flcav.optimization.allocation.vehicles import Shares, TooSlow, split_plan, sum_busy, trains
from flcav.optimization.problem import BITS_PER_BYTE, AllocationTask, Problem
from flcav.optimization.solvers.instance import Clock, Infeasible

HALVINGS = 9  # steps of the bisection over the share of a budget
ROUNDING = 1e-9  # relative tolerance of budgets and objectives
SHORTEST_S = 1e-9  # a round's time, to divide by
OPTIMAL = 1e-4  # largest gap of a plan that is called optimal
CARRIED = "the vehicles' own links, within horizon_s, limit this plan"
IN_TIME = "the vehicles' time to send and to train, within horizon_s, limits this plan"

Carried = tuple[Allocation, Shares]  # a plan and its split over the vehicles
Relaxation = Callable[[float], Allocation]  # the plan of a relaxation by the share of its budget, 0 to 1


def allocate_fleet(problem: Problem) -> Carried:
    """Return the best plan that the vehicles can carry out, and each vehicle's share of it, by task.

    Tasks without named vehicles are planned under the budgets only and have no shares. Raises `Infeasible` where the
    limits ask for more than the budgets or the samples held, and `TooSlow` where no plan fits the horizon.
    """
    if not any(task.vehicles for task in problem.tasks):
        return _timed(problem, (allocate(problem), {}))
    found: list[Carried] = []
    refused: list[Infeasible] = []
    certificate: list[Dual] = []
    for choices, settled in list_settled(problem):
        try:
            bounded = settled.model_copy(update={"tasks": tuple(_within_held(task) for task in settled.tasks)})
            plan = allocate(bounded)
            certificate += plan.certificate
            least = min((best.objective for best, _ in found), default=np.inf)
            if problem.objective != "area" and (plan.lower_bound or 0.0) >= least:
                continue
            carried, shares = _carry(bounded, plan)
            found.append((name_choices(carried, choices), shares))
        except Infeasible as error:
            refused.append(error)
    if not found:
        raise refused[0]
    best = join_plans(problem, [plan for plan, _ in found], OPTIMAL, tuple(certificate))
    return best, next(shares for plan, shares in found if plan.tasks is best.tasks)


def _carry(bounded: Problem, plan: Allocation) -> Carried:
    """Return `plan`, the best one within the budgets, or the best that the vehicles can carry out, with its split."""
    try:
        return _timed(bounded, (plan, split_plan(bounded, plan.tasks)))
    except TooSlow as error:
        training = trains(bounded)
        relaxations = _all_join_in_time(bounded) if training else [_all_join(bounded, plan)]
        bounds = [plan.lower_bound]
        if training or all(task.vehicles for task in bounded.tasks):
            relaxations.insert(0, (_one_joins_in_time if training else _one_joins)(bounded))
            bounds.append(_bound(relaxations[0]))
        lower = max((bound for bound in bounds if bound is not None), default=None)
        feasible: list[Carried] = []
        for relaxed in relaxations:
            if carried := _largest(bounded, relaxed):
                feasible.append(carried)
                if lower is not None and carried[0].objective <= lower * (1 + ROUNDING):
                    break  # no plan is better
        if not feasible:
            raise error
        carried, shares = _certified(bounded, feasible, lower, IN_TIME if training else CARRIED)
        return _timed(bounded, (replace(carried, certificate=plan.certificate), shares))


def _within_held(task: AllocationTask) -> AllocationTask:
    """Return the task with its upper limit of samples lowered to what its vehicles hold.

    Raises `Infeasible` if its lower limit exceeds that.
    """
    vehicles = task.vehicles
    if not vehicles or any(vehicle not in task.samples_held for vehicle in vehicles):
        return task
    held = sum(task.samples_held[vehicle] for vehicle in vehicles)
    least, most = task.limits.samples
    if held < least:
        raise Infeasible(
            f"task {task.name!r}: its vehicles hold {plural(held, 'sample')} (samples_held), "
            f"and limits.samples starts at {least}"
        )
    limits = task.limits.model_copy(update={"samples": (least, min(most, held))})
    return task.model_copy(update={"limits": limits})


def _all_join(asked: Problem, plan: Allocation) -> Relaxation:
    return lambda share: allocate(_with_wireless(asked, share * plan.used_mb.wireless_mb, asked.tasks))


def _one_joins(asked: Problem) -> Relaxation:
    links = {name: link.wireless for task in asked.tasks for name, link in (task.uplink_mbps or {}).items()}
    carried_mb = min(sum(links.values()) * _horizon_s(asked) / BITS_PER_BYTE, asked.budgets_mb.wireless)
    tasks = _of_one_each(asked)
    return lambda share: allocate(_with_wireless(asked, share * carried_mb, tasks))


def _of_one_each(asked: Problem) -> tuple[AllocationTask, ...]:
    """Return the tasks, with one vehicle per edge group in those whose vehicles are named."""
    ones = ({"edge_groups": (1,) * len(task.edge_groups)} if task.vehicles else {} for task in asked.tasks)
    return tuple(task.model_copy(update=update) for task, update in zip(asked.tasks, ones))


def _all_join_in_time(asked: Problem) -> list[Relaxation]:
    """Return the plans by the rounds that the slowest vehicle has time for, without and with the time for samples."""
    horizon_s = _horizon_s(asked)
    vehicles = {name for task in asked.tasks for name in task.vehicles}
    slowest = max(vehicles, key=lambda name: (sum(t.round_s(name) for t in asked.tasks if name in t.vehicles), name))
    per_round = tuple(task.round_s(slowest) if slowest in task.vehicles else 0.0 for task in asked.tasks)
    mbps = [sum(link.wireless for link in (task.uplink_mbps or {}).values()) for task in asked.tasks]
    sending = (BITS_PER_BYTE * task.sample_mb / rate if rate else 0.0 for task, rate in zip(asked.tasks, mbps))
    return [
        _reduced(asked, Clock((0.0,) * len(per_round), per_round, horizon_s)),
        _reduced(asked, Clock(tuple(sending), per_round, 2 * horizon_s)),
    ]


def _one_joins_in_time(asked: Problem) -> Relaxation:
    times: dict[str, list[float]] = {}
    for task in asked.tasks:
        for name in task.vehicles:
            times.setdefault(name, []).append(task.round_s(name))
    speed = {name: 1 / max(float(np.mean(rounds_s)), SHORTEST_S) for name, rounds_s in times.items()}
    per_sample = tuple(
        min((speed[name] * task.sample_s(name) for name in task.vehicles), default=0.0) for task in asked.tasks
    )
    per_round = tuple(
        sum(min(speed[name] * task.round_s(name) for name in group) for group in _groups(task)) for task in asked.tasks
    )
    clock = Clock(per_sample, per_round, _horizon_s(asked) * sum(speed.values()))
    return _reduced(asked.model_copy(update={"tasks": _of_one_each(asked)}), clock)


def _groups(task: AllocationTask) -> list[tuple[str, ...]]:
    """Return the names of the vehicles by edge group; no groups where they are not named."""
    left = iter(task.vehicles)
    return [tuple(islice(left, size)) for size in task.edge_groups] if task.vehicles else []


def _reduced(asked: Problem, clock: Clock) -> Relaxation:
    return lambda share: allocate(asked, clocks=(replace(clock, seconds=share * clock.seconds),))


def _horizon_s(asked: Problem) -> float:
    assert asked.horizon_s is not None
    return asked.horizon_s


def _with_wireless(asked: Problem, wireless_mb: float, tasks: tuple[AllocationTask, ...]) -> Problem:
    budgets = asked.budgets_mb.model_copy(update={"wireless": wireless_mb})
    return asked.model_copy(update={"budgets_mb": budgets, "tasks": tasks})


def _largest(asked: Problem, relaxed: Relaxation) -> Carried | None:
    """Return the plan of the largest share of the budget that can be carried out, by bisection; None if none can."""
    low, high, share, found = 0.0, 1.0, 1.0, None
    for _ in range(HALVINGS + 1):
        # Bisection on feasibility: TooSlow asks for less of the budget, Infeasible for more.
        try:
            found, low = _carried(asked, relaxed(share)), share
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
        return relaxed(1.0).lower_bound
    except Infeasible:
        return None


def _timed(asked: Problem, carried: Carried) -> Carried:
    """Return the plan with the time of the busiest vehicle, named or not, where vehicles train."""
    plan, shares = carried
    if asked.horizon_s is None or not trains(asked):
        return carried
    return replace(plan, busy_s=max([plan.busy_s or 0.0, *sum_busy(shares).values()])), shares


def _certified(asked: Problem, found: Sequence[Carried], bound: float | None, limit: str) -> Carried:
    """Return the best plan with its certificate; its derivative by the wireless budget is unknown and set to 0.

    `limit` is a sentence on what limits the plan.
    """
    larger = asked.objective == "area"
    plan, shares = (max if larger else min)(found, key=lambda carried: carried[0].objective)
    lower = None if bound is None else min(bound, plan.objective)
    gap = None if lower is None else relative_gap(plan.objective, lower)
    rates = LinkMegabytes(0.0, plan.marginal_error_per_gb.wireline_mb)
    notes = (plan.note, limit)
    certified = replace(
        plan,
        status="optimal" if gap is not None and gap <= OPTIMAL else "feasible",
        lower_bound=lower,
        gap=gap,
        marginal_error_per_gb=rates,
        note="; ".join(note for note in notes if note),
    )
    return certified, shares
