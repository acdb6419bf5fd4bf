"""Allocation of both uplink budgets to the samples and rounds of all tasks, by learning curves of earlier runs.

`remake_plan` plans the rest of a run anew, from what it has reached and spent.
"""

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow.csv

from flcav.config import Config, InputError, parse_config
from flcav.federation.rules import Rules
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.selection import Selection
from flcav.federation.strategies import exchanges_more
from flcav.federation.upload import Upload
from flcav.network.ledger import BYTES_PER_MB
from flcav.network.plan import MessageSizes, Price, StagePlan, price
from flcav.optimization.allocation.allocate import TaskPlan as Allotted
from flcav.optimization.allocation.baselines import baseline
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.replanning import PlanState, Sent, TaskState, condition_problem
from flcav.optimization.allocation.vehicles import Shares
from flcav.optimization.curves.fitting import CurveFit, fit
from flcav.optimization.curves.history import History, parse_histories
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Infeasible
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.weights import to_arrays
from flcav.pipeline.arms import PlanRule, Setting
from flcav.pipeline.recipe import CLOUD, EDGE, PRETRAIN, Federation, FixedPlan, Limits
from flcav.pipeline.results import Plan, StageResult, TaskPlan
from flcav.pipeline.tables import read_table


@dataclass(frozen=True)
class HistoryPoint:
    """A point of the learning history that a run writes: what a task spent, and the score it reached."""

    task: str
    samples: int
    edge_rounds: int
    cloud_rounds: int
    accuracy: float
    weight: int  # validation frames
    run: str


@dataclass(frozen=True)
class PlanRequest:
    """One task as the planner sees it: weight, message sizes, and its learning history or fixed plan."""

    name: str
    weight: float
    sizes: MessageSizes
    pool: int  # samples available for upload
    history: History | None  # None: the plan is fixed
    fixed: FixedPlan | None
    train_s: float = 0.0  # time that a vehicle trains in one round [s]
    air_s: Mapping[str, float] = field(default_factory=dict)  # time of a round's messages on the air [s], by region


@dataclass(frozen=True)
class PlanSettings:
    """Budgets, bounds and topology of the federation, common to the plans of all tasks."""

    budgets_mb: Price
    headroom: float
    limits: Limits
    edge_groups: tuple[int, ...]  # vehicles of each edge server
    edge_rounds_per_cloud_round: int
    group_samples: tuple[int, ...] = ()  # samples that the vehicles of each edge server hold, of each task
    horizon_s: float | None = None  # longest time that a vehicle trains, over all rounds of all tasks [s]
    speeds: Mapping[str, float] = field(default_factory=dict)  # of every vehicle, in the order of the edge servers

    def stage_plan(self, samples: int, edge_rounds: int, cloud_rounds: int) -> StagePlan:
        """Return the transfers of a task with these counts."""
        return StagePlan(samples, edge_rounds, cloud_rounds, self.edge_groups, self.edge_rounds_per_cloud_round)


def make_plan(tasks: tuple[PlanRequest, ...], frame: PlanSettings, rule: PlanRule) -> tuple[Plan, Problem | None]:
    """Return the plan of all tasks, and the allocation problem that was solved for those without a fixed plan.

    Fixed plans are paid first; the problem is None where all are fixed. Raises `InputError` where the budgets do not
    cover the fixed plans, `Infeasible` where the rest does not cover the lower bounds of the other tasks.
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
        for task, own in zip(learned, allotted, strict=True):
            plans[task.name] = make_task_plan(task.sizes, own, problem, shares)
    return Plan(rule, {task.name: plans[task.name] for task in tasks}), problem


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
    except Infeasible:
        allotted, shares = (), {}
    for own in allotted:
        before = tasks[own.name]
        new = make_task_plan(MessageSizes(before.sample_mb, before.model_mb), own, rest, shares)
        assert new.predicted is not None
        assert before.predicted is not None
        past = (PRETRAIN,) if stage == PRETRAIN else (PRETRAIN, EDGE)
        joins = continue_joins(before, new, before.edge_rounds) if stage == EDGE else new.joins
        predicted = {**new.predicted, **{each: before.predicted[each] for each in past}}
        tasks[own.name] = replace(new, predicted=predicted, joins=joins, uploads=before.uploads)
    return Plan(plan.rule, tasks, stage, dict(reached))


def count_carried_out(plan: TaskPlan, stages: Sequence[StageResult]) -> TaskPlan:
    """Return the plan of a task with the edge rounds that its regions carried out, and who joined them.

    `stages` are the results of stage II. Where regions ran different numbers of rounds, theirs is the mean by vehicles.
    """
    rounds = round(float(np.average([each.rounds for each in stages], weights=[each.clients for each in stages])))
    joins = plan.joins
    if joins is not None:
        last = {
            name: own
            for each in stages
            for made in (each.plans or ())[-1:]
            for name, own in (made.plan.joins or {}).items()
        }
        joins = {name: last.get(name, own) for name, own in joins.items()}
    return replace(plan, edge_rounds=rounds, joins=joins)


def allocate_tasks(problem: Problem) -> tuple[Sequence[Allotted], Shares]:
    """Return the best plan and, of vehicles with names, each one's share of it."""
    plan, shares = allocate_fleet(problem)
    return plan.tasks, shares


def continue_joins(before: TaskPlan, new: TaskPlan, over: int) -> Mapping[str, tuple[int, ...]] | None:
    """Return the first `over` rounds that vehicles joined by the plan `before`, and the later ones by the `new` one."""
    if before.joins is None or new.joins is None:
        return new.joins
    return {
        name: tuple(each for each in before.joins[name] if each <= over) + tuple(each for each in joined if each > over)
        for name, joined in new.joins.items()
    }


def fit_curve(history: History, group_samples: tuple[int, ...], k: int) -> CurveFit:
    """Return the learning curve of least AICc: additive or, where cloud rounds vary between regions, federated.

    `group_samples` are the samples held in each region, `k` the edge rounds per cloud round.
    """
    fits: list[CurveFit] = [fit(history)]
    if len(group_samples) > 1 and np.ptp(history.resources[:, 2]) > 0:
        fits.append(fit(history, model="federated", group_samples=group_samples, k=k))
    return min(fits, key=lambda found: found.aicc)


def _problem(tasks: list[PlanRequest], frame: PlanSettings, budgets_mb: np.ndarray) -> Problem:
    """Return the allocation problem, as `flcav allocate` reads it."""
    wireless, wireline = budgets_mb.tolist()
    values = {
        "budgets_mb": {"wireless": wireless, "wireline": wireline},
        "edge_rounds_per_cloud_round": frame.edge_rounds_per_cloud_round,
        "horizon_s": frame.horizon_s,
        "tasks": [_task(task, frame) for task in tasks],
    }
    return parse_config(Problem, values, "the run's allocation problem")


def _task(task: PlanRequest, frame: PlanSettings) -> dict[str, Any]:
    assert task.history is not None
    found = fit_curve(task.history, frame.group_samples, frame.edge_rounds_per_cloud_round)
    least, most = frame.limits.samples
    most = task.pool if most is None else min(most, task.pool)
    measured = task.history.resources.max(axis=0)
    edge, cloud = (
        (low, max(low, int(reached)) if cap is None else cap)
        for (low, cap), reached in zip((frame.limits.edge_rounds, frame.limits.cloud_rounds), measured[1:], strict=True)
    )
    return {
        "name": task.name,
        "weight": task.weight,
        "sample_mb": task.sizes.sample_mb,
        "model_mb": task.sizes.model_mb,
        "edge_groups": list(frame.edge_groups),
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


def _fixed(task: PlanRequest, fixed: FixedPlan, frame: PlanSettings) -> TaskPlan:
    if fixed.samples > task.pool:
        raise InputError(f"tasks.{task.name}.plan: {fixed.samples} samples; the pools hold {task.pool}")
    counts = (fixed.samples, fixed.edge_rounds, fixed.cloud_rounds)
    cost = price(frame.stage_plan(*counts), task.sizes)
    return TaskPlan(*counts, cost.wireless_mb, cost.wireline_mb, task.sizes.sample_mb, task.sizes.model_mb, None)


def make_task_plan(sizes: MessageSizes, own: Allotted, problem: Problem, shares: Shares) -> TaskPlan:
    """Return the plan of a task by its allocation in `problem`: scores predicted after each stage, rounds to join."""
    curve = next(each.curve for each in problem.tasks if each.name == own.name)
    k, counts = problem.edge_rounds_per_cloud_round, (own.samples, own.edge_rounds, own.cloud_rounds)
    spent = {PRETRAIN: (counts[0], 0, 0), EDGE: (*counts[:2], 0), CLOUD: counts}
    predicted = {stage: max(1 - float(curve.error(*each, k)), 0.0) for stage, each in spent.items()}
    joins = {each.vehicle: each.rounds for each in shares[own.name]} if own.name in shares else None
    return TaskPlan(*counts, own.wireless_mb, own.wireline_mb, sizes.sample_mb, sizes.model_mb, predicted, joins)


class UpdateForm(Config):
    """What a client's update is sent as, as far as its size depends on it."""

    upload: Upload = Upload()
    exchanging: bool = False  # with an array beside each that is learned


def update_forms(settings: Iterable[Setting]) -> list[UpdateForm]:
    """Return the different forms of the arms' updates, in the order of the arms."""
    forms = []
    for setting in settings:
        how = setting.federation
        form = UpdateForm(upload=how.upload, exchanging=exchanges_more(how.strategy))
        if form not in forms and setting.central is None:
            forms.append(form)
    return forms


def follow_plan(how: Federation, plan: TaskPlan, done: int) -> Rules:
    """Return the rules by which vehicles join the rounds that the plan gives them, after `done` rounds.

    Another selection than that of all vehicles goes before the plan's.
    """
    if plan.joins is None or how.selection.rule != "all":
        return how
    return how.model_copy(update={"selection": Selection(rule="planned", joins=plan.joins_after(done))})


def model_mb(task: Task, network: str | None, forms: Sequence[UpdateForm] = (UpdateForm(),)) -> float:
    """Return the serialised size of one model update [MB], the largest of its `forms`, by a dry run of the message."""
    weights = to_arrays(build_network(task, find_configuration(task, network), 0))
    return max(update_bytes(weights, form.upload, exchanging=form.exchanging) for form in forms) / BYTES_PER_MB


def read_history(task: str, name: str, beside: Path) -> str:
    """Return the text of a task's learning history (CSV): one of the package by its name, or a file below `beside`.

    Raises `InputError` where there is no such table, or it has no rows of the task.
    """
    text = read_table(f"tasks.{task}.history", name, "history", "histories", beside)
    parse_history(task, text, name)
    return text


def parse_history(task: str, text: str, origin: str) -> History:
    """Return the task's points in a history (CSV); raises `InputError`, naming `origin`, where there are none."""
    try:
        table = pyarrow.csv.read_csv(io.BytesIO(text.encode()))
    except pyarrow.ArrowInvalid as error:
        raise InputError(f"{origin}: not a CSV table ({error})") from None
    found = parse_histories(table.to_pydict(), origin, task)
    if task not in found:
        raise InputError(f"tasks.{task}.history: {origin} has no rows of '{task}', but of {', '.join(found)}")
    return found[task]


def load_history(name: str) -> History:
    """Return the package's learning history of the task `name`."""
    return parse_history(name, read_history(name, name, Path()), name)
