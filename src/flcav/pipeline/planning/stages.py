"""Re-planning of the rest of a run after stage I or II, from what it has reached and spent."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Literal

import numpy as np

from flcav.network.plan import Price
from flcav.optimization.allocation.replanning import PlanState, Sent, TaskState, condition_problem
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Infeasible
from flcav.pipeline.planning.allocation import allocate_tasks, make_task_plan
from flcav.pipeline.recipe import EDGE, PRETRAIN
from flcav.pipeline.results.plans import Plan, TaskPlan
from flcav.pipeline.results.training import StageResult


def remake_plan(
    plan: Plan,
    problem: Problem,
    stage: Literal["pretrain", "edge"],
    reached: Mapping[str, float],
    used_mb: Price,
    done: Mapping[str, TaskPlan] = {},
) -> Plan:
    """Return the plan of the rest of a run after `stage`, which `plan` was carried out in; fixed plans stay.

    `problem` is that of the first plan, `reached` the score of each of its tasks now, `used_mb` what they have sent.
    Counts are totals, including what is spent. Scores predicted of stages that are over are kept. Where what is left of
    the budgets allows no other plan, the counts are those of `plan`. `done` are the plans of tasks whose stage came out
    otherwise than planned, with the rounds that were carried out.
    """
    states, tasks = {}, {**plan.tasks, **done}
    for task in problem.tasks:
        own = tasks[task.name]
        counts = (own.samples, own.edge_rounds if stage == EDGE else 0, 0)
        predicted = float(task.curve.error(*counts, problem.edge_rounds_per_cloud_round))
        known = 0 < predicted < np.inf  # a curve without points before the first round has no error there
        states[task.name] = TaskState(
            samples=counts[0], edge_rounds=counts[1], accuracy=reached[task.name] if known else None, ended=stage
        )
    sent = Sent(wireless=used_mb.wireless_mb, wireline=used_mb.wireline_mb)
    rest = condition_problem(problem, PlanState(tasks=states, used_mb=sent))
    try:
        allotted, shares = allocate_tasks(rest)
        made = {own.name: make_task_plan(tasks[own.name].sizes, own, rest, shares) for own in allotted}
        over = {name: tasks[name].edge_rounds if stage == EDGE else 0 for name in made}
        joins = {name: continue_joins(tasks[name], new, over[name]) for name, new in made.items()}
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


def count_carried_out(plan: TaskPlan, stages: Sequence[StageResult]) -> TaskPlan:
    """Return the plan of a task with the edge rounds that its regions carried out, and who joined them.

    `stages` are the results of stage II. Where regions ran different numbers of rounds, theirs is the mean by vehicles,
    and the last round of each has that number: first ones of a region that ran more have numbers below 1.
    """
    rounds = round(float(np.average([each.rounds for each in stages], weights=[each.clients for each in stages])))
    joins = plan.joins
    if joins is not None:
        last = {
            name: tuple(number + rounds - each.rounds for number in own)
            for each in stages
            for made in (each.plans or ())[-1:]
            for name, own in (made.plan.joins or {}).items()
        }
        joins = {name: last.get(name, own) for name, own in joins.items()}
    return replace(plan, edge_rounds=rounds, joins=joins)


def continue_joins(before: TaskPlan, new: TaskPlan, over: int) -> Mapping[str, tuple[int, ...]] | None:
    """Return the first `over` rounds that vehicles joined by the plan `before`, and the later ones by the `new` one.

    No vehicle joins more rounds than the new plan gives it in all: where it would, the later rounds of its region are
    dealt anew, round robin, to those that have rounds left. Raises `Infeasible` where these are too few for the rounds.
    """
    if before.joins is None or new.joins is None:
        return new.joins
    past = {name: tuple(each for each in before.joins[name] if each <= over) for name in new.joins}
    later = {name: tuple(each for each in joined if each > over) for name, joined in new.joins.items()}
    most = {name: len(joined) for name, joined in new.joins.items()}
    for region in dict.fromkeys(name.rpartition("/")[0] for name in later):
        own = [name for name in later if name.rpartition("/")[0] == region]
        if any(len(past[name]) + len(later[name]) > most[name] for name in own):
            rounds = sorted({*chain.from_iterable(later[name] for name in own)})
            later |= _deal({name: most[name] - len(past[name]) for name in own}, rounds)
    return {name: past[name] + later[name] for name in later}


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
