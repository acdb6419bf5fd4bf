"""Replanning during a run: resources spent are lower limits, and learning curves are rescaled to observed accuracies.

Stages follow one another: no sample is added after the first edge round, and no edge round after the first cloud round.
"""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from flcav.config import Config, InputError
from flcav.optimization.allocation.choices import narrow, settle_first
from flcav.optimization.curves.curves import (
    STAGES,
    Additive,
    Curve,
    Decay,
    Effective,
    Federated,
    NonNegative,
    Positive,
)
from flcav.optimization.problem import AllocationTask, Budgets, Count, Fraction, Problem, Vehicles
from flcav.optimization.solvers.branches import call_vehicles
from flcav.optimization.solvers.instance import price_counts
from flcav.storage.records import LEFT_OUT

LEAST_ERROR = 1e-6  # error assumed for an accuracy of 1: test sets are finite


class TaskState(Config):
    """The resources that one task has spent so far, and the accuracy of its network now."""

    samples: Count  # samples uploaded so far
    edge_rounds: Count = 0  # edge rounds done
    cloud_rounds: Count = 0  # cloud rounds done
    called: Vehicles | None = (
        None  # vehicles of each edge server that were called to its edge rounds, where a plan says
    )
    local_steps: Annotated[Positive | None, LEFT_OUT] = None  # factor of its rounds so far, where a plan says
    form: Annotated[str | None, LEFT_OUT] = None  # of their updates, where a plan says
    network: Annotated[str | None, LEFT_OUT] = None  # that learned it, where a plan says
    annotation: Annotated[str | None, LEFT_OUT] = None  # of its samples, where a plan says
    accuracy: Fraction | None = (
        None  # accuracy now; None: not measured; of a cluster: the weighted mean of its members'
    )
    ended: Literal["pretrain", "edge"] | None = (
        None  # last stage that nothing more is spent in; default: the one before the last in which something was
    )

    @property
    def counts(self) -> tuple[int, int, int]:
        """Samples, edge rounds, cloud rounds."""
        return self.samples, self.edge_rounds, self.cloud_rounds


class Sent(Config):
    """Uplink messages in the ledger, in total per link [MB]."""

    wireless: NonNegative  # from vehicles to edge servers
    wireline: NonNegative  # from edge servers to the cloud


class PlanState(Config):
    """The state of a plan's execution: resources spent by task, and megabytes sent."""

    document: ClassVar = "the progress of a plan"

    tasks: Annotated[Mapping[str, TaskState], Field(min_length=1)]  # resources spent, by task
    used_mb: Sent | None = None  # megabytes sent; None: the counts times the problem's message sizes


def condition_problem(problem: Problem, progress: PlanState) -> Problem:
    """Return the problem given `progress`: resources spent are lower limits, curves pass through observed accuracies.

    A task's curve and upper band, floors included, are scaled by the ratio of observed to predicted error. Budgets are
    reduced by the difference of megabytes sent and the cost of the counts. Raises `InputError` for a task that is not
    in the problem, where a predicted error cannot be scaled, and where the megabytes sent leave nothing of a budget.
    """
    names = [task.name for task in problem.tasks]
    for name in progress.tasks:
        if name not in names:
            raise InputError(f"progress.tasks names {name!r}, which is none of {', '.join(names)}")
    called = problem.model_copy(
        update={"tasks": tuple(_call(problem, task, progress.tasks.get(task.name)) for task in problem.tasks)}
    )
    tasks = tuple(
        _continued(called, task, progress.tasks[task.name]) if task.name in progress.tasks else task
        for task in called.tasks
    )
    return problem.model_copy(update={"tasks": tasks, "budgets_mb": _left(called, progress)})


def _call(problem: Problem, task: AllocationTask, spent: TaskState | None) -> AllocationTask:
    """Return the task with the choices of what is done: network, annotation, local steps, form, number of vehicles."""
    if spent is not None:
        told = (spent.local_steps, spent.form, spent.network, spent.annotation)
        begun = any(spent.counts if task.alternatives or task.annotations else spent.counts[1:])
        if begun or any(each is not None for each in told):
            task = narrow(task, spent)
    if spent is None or spent.called is None:
        return task
    if task.called is None or not task.called[0] <= spent.called <= task.called[1]:
        raise InputError(f"progress.tasks.{task.name}.called = {spent.called}: the problem does not call so many")
    return call_vehicles(task, spent.called, spent.called, problem.edge_rounds_per_cloud_round)


def _continued(problem: Problem, task: AllocationTask, spent: TaskState) -> AllocationTask:
    fields = ("samples", "edge_rounds", "cloud_rounds")
    limits = {}
    ended = 0 if spent.ended is None else 1 + STAGES.index(spent.ended)
    for stage, (name, done) in enumerate(zip(fields, spent.counts)):
        least, most = getattr(task.limits, name)
        over = any(spent.counts[stage + 1 :]) or stage < ended
        limits[name] = (done, done) if over else (max(least, done), max(most, done))
    update: dict[str, object] = {"limits": task.limits.model_copy(update=limits)}
    if spent.accuracy is not None:
        predicted = float(task.curve.error(*spent.counts, k=problem.edge_rounds_per_cloud_round))
        if not 0 < predicted < float("inf"):
            raise InputError(
                f"progress.tasks.{task.name}.accuracy = {spent.accuracy:g}: its curve predicts an error of "
                f"{predicted:g} there, which cannot be scaled to it"
            )
        factor = max(1 - spent.accuracy, LEAST_ERROR) / predicted
        known = {name: getattr(task, name) for name in ("curve", "upper", "lower")}
        update |= {name: None if curve is None else _scaled(curve, factor) for name, curve in known.items()}
    return task.model_copy(update=update)


def _scaled(curve: Curve, factor: float) -> Curve:
    if isinstance(curve, Additive):
        decays = {name: _smaller(getattr(curve, name), factor) for name in ("pretrain", "edge", "cloud")}
        return curve.model_copy(update={"floor": curve.floor * factor, "merge": curve.merge * factor, **decays})
    if isinstance(curve, Effective):
        return curve.model_copy(update={"floor": curve.floor * factor, "a": curve.a * factor})
    if isinstance(curve, Federated):
        scaled = {name: factor * getattr(curve, name) for name in ("floor", "a", "drift")}
        return curve.model_copy(update=scaled)
    members = (member.model_copy(update={"curve": _scaled(member.curve, factor)}) for member in curve.members)
    return curve.model_copy(update={"members": tuple(members)})


def _smaller(decay: Decay, factor: float) -> Decay:
    return decay.model_copy(update={"a": decay.a * factor})


def _left(problem: Problem, progress: PlanState) -> Budgets:
    """Return the budgets [MB], reduced by the difference of the megabytes sent and the cost of the counts."""
    budgets = problem.budgets_mb
    if progress.used_mb is None:
        return budgets
    done = [
        price_counts(problem, task, progress.tasks[task.name].counts)
        for task in settle_first(problem)[1].tasks
        if task.name in progress.tasks
    ]
    left = {}
    for link in ("wireless", "wireline"):
        priced = sum(getattr(cost, f"{link}_mb") for cost in done)
        left[link] = getattr(budgets, link) - (getattr(progress.used_mb, link) - priced)
        if left[link] <= 0:
            raise InputError(
                f"progress.used_mb.{link} = {getattr(progress.used_mb, link):g} is more than budgets_mb.{link} = "
                f"{getattr(budgets, link):g} can bear"
            )
    return budgets.model_copy(update=left)
