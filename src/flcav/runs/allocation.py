"""Allocation of both uplink budgets to the samples and rounds of all tasks, by learning curves of earlier runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from math import floor
from typing import Any, Literal

import numpy as np

from flcav.config import InputError, parse_config
from flcav.interface.wording import plural
from flcav.network.ledger import LinkMegabytes
from flcav.network.plan import MessageSizes, StagePlan, price
from flcav.optimization.allocation.allocate import TaskAllocation
from flcav.optimization.allocation.baselines import baseline
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.replanning import PlanState, Sent, TaskState, condition_problem
from flcav.optimization.allocation.vehicles import Shares, sum_busy
from flcav.optimization.curves.fitting import fit
from flcav.optimization.curves.history import History
from flcav.optimization.problem import MOST, AllocationTask, Problem
from flcav.optimization.solvers.branches import call_vehicles
from flcav.optimization.solvers.instance import Infeasible
from flcav.runs.arms import PlanRule
from flcav.runs.recipe import CLOUD, EDGE, PRETRAIN, FixedPlan, PlanLimits
from flcav.runs.results.plans import Plan, TaskPlan


@dataclass(frozen=True)
class PlanRequest:
    """The planner's input for one task: weight, message sizes, and its learning history or fixed plan."""

    name: str
    weight: float  # of the task's error in the objective, without unit
    sizes: MessageSizes
    pool: int  # samples available for upload
    history: History | None  # None: the plan is fixed
    fixed: FixedPlan | None
    train_s: float = 0.0  # time that a vehicle of speed 1 trains in one round [s]
    air_s: Mapping[str, float] = field(default_factory=dict)  # time of a round's messages on the air [s], by region


@dataclass(frozen=True)
class PlanSettings:
    """Budgets, bounds and topology of the federation, common to the plans of all tasks."""

    budgets_mb: LinkMegabytes  # of both uplinks [MB]
    headroom: float  # fraction of the budgets left unspent, in [0, 1)
    limits: PlanLimits
    edge_groups: tuple[int, ...]  # numbers of vehicles, by edge server
    edge_rounds_per_cloud_round: int
    group_samples: tuple[int, ...] = ()  # samples per task that the vehicles of an edge server hold, by edge server
    horizon_s: float | None = None  # longest time that a vehicle trains, over all rounds of all tasks [s]
    speeds: Mapping[str, float] = field(default_factory=dict)  # relative computing speeds, by vehicle, servers in order
    called: tuple[int, int] | None = None  # least and most vehicles of a group on request; None: the plan calls nobody
    overlap: float = 0.0  # share of a further vehicle's data that the vehicles called before it already have

    def stage_plan(self, samples: int, edge_rounds: int, cloud_rounds: int) -> StagePlan:
        """Return the transfers of a task with these numbers of samples and rounds."""
        return StagePlan(samples, edge_rounds, cloud_rounds, self.edge_groups, self.edge_rounds_per_cloud_round)


def make_plan(tasks: tuple[PlanRequest, ...], frame: PlanSettings, rule: PlanRule) -> tuple[Plan, Problem | None]:
    """Return the plan of all tasks, and the allocation problem that was solved for those without a fixed plan.

    Fixed plans are paid first; the problem is None where all plans are fixed. Raises `InputError` where the budgets do
    not cover the fixed plans, `Infeasible` where the rest does not cover the lower bounds of the other tasks.
    """
    plans: dict[str, TaskPlan] = {}
    left = np.array([frame.budgets_mb.wireless_mb, frame.budgets_mb.wireline_mb]) * (1 - frame.headroom)
    for task in tasks:
        if task.fixed is not None:
            plans[task.name] = _fixed(task, task.fixed, frame)
            left -= (plans[task.name].wireless_mb, plans[task.name].wireline_mb)
    if (left < 0).any():
        raise InputError(
            f"budgets_mb: the fixed plans take {-left.min():.1f} MB more than "
            f"{'wireless' if left[0] == left.min() else 'wireline'} carries with a headroom of {frame.headroom:.0%}"
        )
    learned = [task for task in tasks if task.history is not None]
    problem = _problem(learned, frame, left) if learned else None
    if problem is not None:
        allotted, shares = (baseline(problem, rule).tasks, {}) if rule != "joint" else allocate_tasks(problem)
        for task, allocation in zip(learned, allotted, strict=True):
            plans[task.name] = make_task_plan(task.sizes, allocation, problem, shares)
    return Plan(rule, {task.name: plans[task.name] for task in tasks}), problem


def allocate_tasks(problem: Problem) -> tuple[Sequence[TaskAllocation], Shares]:
    """Return the optimal plan and, where vehicles are named, their shares of its rounds."""
    plan, shares = allocate_fleet(problem)
    return plan.tasks, shares


def _problem(tasks: list[PlanRequest], frame: PlanSettings, budgets_mb: np.ndarray) -> Problem:
    """Return the allocation problem, in the form that `flcav allocate` reads."""
    wireless, wireline = budgets_mb.tolist()
    values = {
        "budgets_mb": {"wireless": wireless, "wireline": wireline},
        "edge_rounds_per_cloud_round": frame.edge_rounds_per_cloud_round,
        "horizon_s": frame.horizon_s,
        "tasks": [_task(task, frame) for task in tasks],
    }
    problem = parse_config(Problem, values, "the run's allocation problem")
    if frame.called is None:
        return problem
    least, most = (min(bound, max(frame.edge_groups)) for bound in frame.called)
    narrowed = (call_vehicles(task, least, most, frame.edge_rounds_per_cloud_round) for task in problem.tasks)
    return problem.model_copy(update={"tasks": tuple(narrowed)})


def _task(task: PlanRequest, frame: PlanSettings) -> dict[str, Any]:
    assert task.history is not None
    k = frame.edge_rounds_per_cloud_round
    all_ = max(frame.edge_groups)
    found = fit(task.history, model=_choose_model(task.history, frame), group_samples=frame.group_samples, k=k)
    least, most = frame.limits.samples
    most = task.pool if most is None else min(most, task.pool)
    measured = task.history.resources.max(axis=0)  # curves are not extrapolated beyond the rounds of the history
    edge, cloud = (
        (low, max(low, int(reached)) if cap is None else cap)
        for (low, cap), reached in zip((frame.limits.edge_rounds, frame.limits.cloud_rounds), measured[1:], strict=True)
    )
    return {
        "name": task.name,
        "weight": task.weight,
        "sample_mb": task.sizes.sample_mb,
        "model_mb": task.sizes.model_mb,
        "exchange_mb": task.sizes.exchange_mb,
        "labels_mb": task.sizes.labels_mb,
        "edge_groups": list(frame.edge_groups),
        "called": None if frame.called is None else [1, all_],
        "worth": None if frame.called is None else [(1 - frame.overlap) ** number for number in range(all_)],
        "limits": {
            "samples": [min(least, most), most],
            "edge_rounds": edge,
            "cloud_rounds": cloud,
        },
        "train_s": task.train_s,
        "vehicle_train_s": {
            name: task.train_s / speed + task.air_s.get(name.rpartition("/")[0], 0.0)
            for name, speed in frame.speeds.items()
        },
        "curve": found.curve.model_dump(),
    }


def _choose_model(history: History, frame: PlanSettings) -> Literal["best", "effective", "federated"]:
    """Return the model of the learning curve: the best fit or, if vehicles are called, one that uses their data."""
    if frame.called is None:
        return "best"
    several = len(frame.group_samples) > 1 and np.ptp(history.resources[:, 2]) > 0
    return "federated" if several else "effective"


def _fixed(task: PlanRequest, fixed: FixedPlan, frame: PlanSettings) -> TaskPlan:
    if fixed.samples > task.pool:
        raise InputError(f"tasks.{task.name}.plan: {plural(fixed.samples, 'sample')}; the pools hold {task.pool}")
    counts = (fixed.samples, fixed.edge_rounds, fixed.cloud_rounds)
    cost = price(frame.stage_plan(*counts), task.sizes)
    return _task_plan(counts, cost, task.sizes, None)


def make_task_plan(sizes: MessageSizes, own: TaskAllocation, problem: Problem, shares: Shares) -> TaskPlan:
    """Return the plan of a task by its allocation `own` in `problem`, with predicted scores and the rounds to join."""
    task = next(task for task in problem.tasks if task.name == own.name)
    k = problem.edge_rounds_per_cloud_round
    counts = (own.samples, own.edge_rounds, own.cloud_rounds)
    curve = task.curve if own.called is None else call_vehicles(task, own.called, own.called, k).curve
    spent = {PRETRAIN: (counts[0], 0, 0), EDGE: (*counts[:2], 0), CLOUD: counts}
    predicted = {stage: max(1 - float(curve.error(*totals, k)), 0.0) for stage, totals in spent.items()}
    joins = {share.vehicle: share.rounds for share in shares[own.name]} if own.name in shares else None
    return _task_plan(counts, LinkMegabytes(own.wireless_mb, own.wireline_mb), sizes, predicted, joins, own.called)


def _task_plan(
    counts: tuple[int, int, int],
    cost: LinkMegabytes,
    sizes: MessageSizes,
    predicted: Mapping[str, float] | None,
    joins: Mapping[str, tuple[int, ...]] | None = None,
    called: int | None = None,
) -> TaskPlan:
    return TaskPlan(
        *counts,
        wireless_mb=cost.wireless_mb,
        wireline_mb=cost.wireline_mb,
        sample_mb=sizes.sample_mb,
        model_mb=sizes.model_mb,
        predicted=predicted,
        joins=joins,
        exchange_mb=sizes.exchange_mb,
        labels_mb=sizes.labels_mb,
        called=called,
    )


ROUNDING = 1e-6  # of a round: tolerance for floating-point error in the number of rounds that fit
Joins = Mapping[str, tuple[int, ...]]  # rounds by vehicle


def remake_plan(
    plan: Plan,
    problem: Problem,
    stage: Literal["pretrain", "edge"],
    reached: Mapping[str, float],
    used_mb: LinkMegabytes,
) -> Plan:
    """Return the plan for the rest of a run after `stage`, in which `plan` was carried out; fixed plans stay.

    `problem` is that of the first plan, `reached` the current score by task, `used_mb` the uplink traffic so far [MB].
    Counts are totals, including what is spent. Scores predicted for finished stages are kept. The plans of all tasks
    stay where the remaining budgets allow no other plan, or where the vehicles of a region have too little time left
    for the rounds of any task.
    """
    states = {}
    tasks = {**plan.tasks}
    for task in problem.tasks:
        planned = tasks[task.name]
        counts = (planned.samples, planned.edge_rounds if stage == EDGE else 0, 0)
        predicted = float(task.curve.error(*counts, problem.edge_rounds_per_cloud_round))
        known = 0 < predicted < np.inf  # a curve without points before the first round has no error there
        states[task.name] = TaskState(
            samples=counts[0],
            edge_rounds=counts[1],
            called=planned.called if stage == EDGE else None,
            accuracy=reached[task.name] if known else None,
            ended=stage,
        )
    sent = Sent(wireless=used_mb.wireless_mb, wireline=used_mb.wireline_mb)
    rest = condition_problem(problem, PlanState(tasks=states, used_mb=sent))
    try:
        allotted, shares = allocate_tasks(rest)
        made = {
            allocated.name: make_task_plan(tasks[allocated.name].sizes, allocated, rest, shares)
            for allocated in allotted
        }
        over = {name: tasks[name].edge_rounds if stage == EDGE else 0 for name in made}
        spare_s, joins = find_spare(rest, shares), {}
        for task in rest.tasks:
            new = made[task.name]
            joins[task.name] = continue_joins(tasks[task.name], new, over[task.name], task, spare_s)
            # Tasks share their vehicles' time: what this one takes beyond its share is gone for those after it.
            for name, joined in (joins[task.name] or {}).items():
                spare_s[name] -= (len(joined) - len((new.joins or {})[name])) * task.round_s(name)
    except Infeasible:
        made = {}
        joins = {}
    for name, new in made.items():
        before = tasks[name]
        assert new.predicted is not None
        assert before.predicted is not None
        past = (PRETRAIN,) if stage == PRETRAIN else (PRETRAIN, EDGE)
        predicted = {**new.predicted, **{done: before.predicted[done] for done in past}}
        tasks[name] = replace(new, predicted=predicted, joins=joins[name], uploads=before.uploads)
    return Plan(plan.rule, tasks, stage, dict(reached))


def find_spare(problem: Problem, shares: Shares) -> dict[str, float]:
    """Return the time of the horizon that a vehicle's shares of all tasks leave [s], by vehicle; inf without one."""
    horizon_s = np.inf if problem.horizon_s is None else problem.horizon_s
    return {name: horizon_s - busy_s for name, busy_s in sum_busy(shares).items()}


def continue_joins(
    before: TaskPlan, new: TaskPlan, over: int, task: AllocationTask, spare_s: Mapping[str, float]
) -> Joins | None:
    """Return the rounds that vehicles join, by vehicle: the first `over` by the plan `before`, later ones by `new`.

    `spare_s`: time that the new plan leaves a vehicle [s], by vehicle, see `find_spare`; a round takes the `round_s` of
    `task`. No vehicle joins more rounds in all than it has time for: where it would, the later rounds of its region are
    dealt again, round robin, to the vehicles with time left. Raises `Infeasible` where they have too little.
    """
    if before.joins is None or new.joins is None:
        return new.joins
    past = {name: tuple(number for number in before.joins[name] if number <= over) for name in new.joins}
    later = {name: tuple(number for number in joined if number > over) for name, joined in new.joins.items()}
    most = {name: len(joined) + _further(spare_s[name], task.round_s(name)) for name, joined in new.joins.items()}
    for region in dict.fromkeys(name.rpartition("/")[0] for name in later):
        vehicles = [name for name in later if name.rpartition("/")[0] == region]
        if any(len(past[name]) + len(later[name]) > most[name] for name in vehicles):
            rounds = sorted({*chain.from_iterable(later[name] for name in vehicles)})
            later |= _deal({name: most[name] - len(past[name]) for name in vehicles}, rounds)
    return {name: past[name] + later[name] for name in later}


def _further(spare_s: float, round_s: float) -> int:
    """Return the number of further rounds of `round_s` [s] that fit in `spare_s` [s]; negative: rounds too many."""
    return MOST if round_s == 0 else floor(min(spare_s / round_s, MOST) + ROUNDING)


def _deal(left: Mapping[str, int], rounds: Sequence[int]) -> dict[str, tuple[int, ...]]:
    """Deal `rounds` to vehicles, round robin; `left`: rounds that a vehicle can still take, by vehicle."""
    dealt = {}
    start = 0
    for name, many in left.items():
        count = min(max(many, 0), len(rounds))
        dealt[name] = tuple(sorted(rounds[(start + number) % len(rounds)] for number in range(count)))
        start += count
    if start < len(rounds):
        raise Infeasible(f"{start} rounds are left to the vehicles of a region, which has {len(rounds)} to go")
    return dealt
