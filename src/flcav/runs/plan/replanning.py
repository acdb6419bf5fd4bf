"""Re-planning of the rest of a run after stage I or II, from what it has reached and spent."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from math import floor
from typing import Literal

import numpy as np

from flcav.network.ledger import LinkMegabytes
from flcav.optimization.allocation.replanning import PlanState, Sent, TaskState, condition_problem
from flcav.optimization.allocation.vehicles import Shares, sum_busy
from flcav.optimization.problem import MOST, AllocationTask, Problem
from flcav.optimization.solvers.instance import Infeasible
from flcav.runs.plan.allocation import allocate_tasks, make_task_plan
from flcav.runs.recipe import EDGE, PRETRAIN
from flcav.runs.results.plans import Plan, TaskPlan

ROUNDING = 1e-6  # of a round, which there is time for all the same
Joins = Mapping[str, tuple[int, ...]]  # rounds by vehicle


def remake_plan(
    plan: Plan,
    problem: Problem,
    stage: Literal["pretrain", "edge"],
    reached: Mapping[str, float],
    used_mb: LinkMegabytes,
) -> Plan:
    """Return the plan of the rest of a run after `stage`, which `plan` was carried out in; fixed plans stay.

    `problem` is that of the first plan, `reached` the score of each of its tasks now, `used_mb` what they have sent.
    Counts are totals, including what is spent. Scores predicted of stages that are over are kept. Where what is left of
    the budgets allows no other plan, or in any task a region's vehicles have too little time left for its rounds, the
    plans of all tasks stay.
    """
    states, tasks = {}, {**plan.tasks}
    for task in problem.tasks:
        own = tasks[task.name]
        counts = (own.samples, own.edge_rounds if stage == EDGE else 0, 0)
        predicted = float(task.curve.error(*counts, problem.edge_rounds_per_cloud_round))
        known = 0 < predicted < np.inf  # a curve without points before the first round has no error there
        states[task.name] = TaskState(
            samples=counts[0],
            edge_rounds=counts[1],
            called=own.called if stage == EDGE else None,
            accuracy=reached[task.name] if known else None,
            ended=stage,
        )
    sent = Sent(wireless=used_mb.wireless_mb, wireline=used_mb.wireline_mb)
    rest = condition_problem(problem, PlanState(tasks=states, used_mb=sent))
    try:
        allotted, shares = allocate_tasks(rest)
        made = {own.name: make_task_plan(tasks[own.name].sizes, own, rest, shares) for own in allotted}
        over = {name: tasks[name].edge_rounds if stage == EDGE else 0 for name in made}
        spare_s, joins = find_spare(rest, shares), {}
        for own in rest.tasks:
            new = made[own.name]
            joins[own.name] = continue_joins(tasks[own.name], new, over[own.name], own, spare_s)
            for name, joined in (joins[own.name] or {}).items():
                spare_s[name] -= (len(joined) - len((new.joins or {})[name])) * own.round_s(name)
    except Infeasible:
        made, joins = {}, {}
    for name, new in made.items():
        before = tasks[name]
        assert new.predicted is not None
        assert before.predicted is not None
        past = (PRETRAIN,) if stage == PRETRAIN else (PRETRAIN, EDGE)
        predicted = {**new.predicted, **{each: before.predicted[each] for each in past}}
        tasks[name] = replace(new, predicted=predicted, joins=joins[name], uploads=before.uploads)
    return Plan(plan.rule, tasks, stage, dict(reached))


def find_spare(problem: Problem, shares: Shares) -> dict[str, float]:
    """Return the time that each vehicle's shares of all tasks leave of the horizon [s]; inf without a horizon."""
    horizon_s = np.inf if problem.horizon_s is None else problem.horizon_s
    return {name: horizon_s - busy_s for name, busy_s in sum_busy(shares).items()}


def continue_joins(
    before: TaskPlan, new: TaskPlan, over: int, task: AllocationTask, spare_s: Mapping[str, float]
) -> Joins | None:
    """Return the first `over` rounds that vehicles joined by the plan `before`, and the later ones by the `new` one.

    spare_s: what the new plan leaves of each vehicle's time [s], as `find_spare` finds it; a round takes the `round_s`
    of `task`. No vehicle joins more rounds in all than it has time for: where it would, the later rounds of its region
    are dealt again, round robin, to those that have rounds left.
    Raises `Infeasible` where these are too few for the rounds.
    """
    if before.joins is None or new.joins is None:
        return new.joins
    past = {name: tuple(each for each in before.joins[name] if each <= over) for name in new.joins}
    later = {name: tuple(each for each in own if each > over) for name, own in new.joins.items()}
    most = {name: len(joined) + _further(spare_s[name], task.round_s(name)) for name, joined in new.joins.items()}
    for region in dict.fromkeys(name.rpartition("/")[0] for name in later):
        own = [name for name in later if name.rpartition("/")[0] == region]
        if any(len(past[name]) + len(later[name]) > most[name] for name in own):
            rounds = sorted({*chain.from_iterable(later[name] for name in own)})
            later |= _deal({name: most[name] - len(past[name]) for name in own}, rounds)
    return {name: past[name] + later[name] for name in later}


def _further(spare_s: float, round_s: float) -> int:
    """Return how many more rounds of `round_s` there is time for; below 0: how many fewer."""
    return MOST if round_s == 0 else floor(min(spare_s / round_s, MOST) + ROUNDING)


def _deal(left: Mapping[str, int], rounds: Sequence[int]) -> dict[str, tuple[int, ...]]:
    """Return which of `rounds` each vehicle joins, of which it has so many `left`: each starts where the last ended."""
    dealt, start = {}, 0
    for name, many in left.items():
        count = min(max(many, 0), len(rounds))
        dealt[name] = tuple(sorted(rounds[(start + number) % len(rounds)] for number in range(count)))
        start += count
    if start < len(rounds):
        raise Infeasible(f"{start} rounds are left to the vehicles of a region, which has {len(rounds)} to go")
    return dealt
