"""Allocation of both uplink budgets to the samples and rounds of all tasks, by learning curves of earlier runs."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv

from flcav.config import InputError, parse_config
from flcav.federation.runtimes.embedded import update_bytes
from flcav.network.ledger import BYTES_PER_MB
from flcav.network.plan import MessageSizes, Price, StagePlan, price
from flcav.optimization.allocation.allocate import TaskPlan as Allotted
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.allocation.baselines import baseline
from flcav.optimization.curves.fitting import fit_additive
from flcav.optimization.curves.history import History, parse_histories
from flcav.optimization.problem import Problem
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.weights import to_arrays
from flcav.pipeline.arms import PlanRule
from flcav.pipeline.recipe import CLOUD, EDGE, PRETRAIN, FixedPlan, Limits
from flcav.pipeline.results import Plan, TaskPlan
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


@dataclass(frozen=True)
class PlanSettings:
    """Budgets, bounds and topology of the federation, common to the plans of all tasks."""

    budgets_mb: Price
    headroom: float
    limits: Limits
    edge_groups: tuple[int, ...]  # vehicles of each edge server
    edge_rounds_per_cloud_round: int

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
        allotted = allocate(problem).tasks if rule == "joint" else baseline(problem, rule).tasks
        for task, own in zip(learned, allotted, strict=True):
            plans[task.name] = _planned(task, own, problem)
    return Plan(rule, {task.name: plans[task.name] for task in tasks}), problem


def _problem(tasks: list[PlanRequest], frame: PlanSettings, budgets_mb: np.ndarray) -> Problem:
    """Return the allocation problem, as `flcav allocate` reads it."""
    wireless, wireline = budgets_mb.tolist()
    values = {
        "budgets_mb": {"wireless": wireless, "wireline": wireline},
        "edge_rounds_per_cloud_round": frame.edge_rounds_per_cloud_round,
        "tasks": [_task(task, frame) for task in tasks],
    }
    return parse_config(Problem, values, "the run's allocation problem")


def _task(task: PlanRequest, frame: PlanSettings) -> dict[str, Any]:
    assert task.history is not None
    samples, edge_rounds, cloud_rounds = task.history.resources.T
    fit = fit_additive(samples, edge_rounds, cloud_rounds, task.history.accuracy, task.history.weight)
    least, most = frame.limits.samples
    most = task.pool if most is None else min(most, task.pool)
    return {
        "name": task.name,
        "weight": task.weight,
        "sample_mb": task.sizes.sample_mb,
        "model_mb": task.sizes.model_mb,
        "edge_groups": list(frame.edge_groups),
        "limits": {
            "samples": [min(least, most), most],
            "edge_rounds": list(frame.limits.edge_rounds),
            "cloud_rounds": list(frame.limits.cloud_rounds),
        },
        "curve": fit.curve.model_dump(),
    }


def _fixed(task: PlanRequest, fixed: FixedPlan, frame: PlanSettings) -> TaskPlan:
    if fixed.samples > task.pool:
        raise InputError(f"tasks.{task.name}.plan: {fixed.samples} samples; the pools hold {task.pool}")
    counts = (fixed.samples, fixed.edge_rounds, fixed.cloud_rounds)
    cost = price(frame.stage_plan(*counts), task.sizes)
    return TaskPlan(*counts, cost.wireless_mb, cost.wireline_mb, task.sizes.sample_mb, task.sizes.model_mb, None)


def _planned(task: PlanRequest, own: Allotted, problem: Problem) -> TaskPlan:
    curve = next(each.curve for each in problem.tasks if each.name == task.name)
    k, counts = problem.edge_rounds_per_cloud_round, (own.samples, own.edge_rounds, own.cloud_rounds)
    spent = {PRETRAIN: (counts[0], 0, 0), EDGE: (*counts[:2], 0), CLOUD: counts}
    predicted = {stage: max(1 - float(curve.error(*each, k)), 0.0) for stage, each in spent.items()}
    sizes = task.sizes
    return TaskPlan(*counts, own.wireless_mb, own.wireline_mb, sizes.sample_mb, sizes.model_mb, predicted)


def model_mb(task: Task, network: str | None) -> float:
    """Return the serialised size of one model update [MB], by a dry run of the message."""
    return update_bytes(to_arrays(build_network(task, find_configuration(task, network), 0))) / BYTES_PER_MB


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
