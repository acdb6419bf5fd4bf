"""Choices of a plan for each task: its network and modalities, the annotation of samples, local steps, form of updates.

A task may have alternatives, the same task by other networks that read other modalities, with sizes, vehicles and
curves of their own; a plan takes one. A way of annotation decides how long a sample of stage I takes, and what its
noise leaves of it: a curve after x samples is that of the history after `worth` x, and its error is larger by `loss`.
The local steps multiply a vehicle's training time, and a round is worth other numbers of rounds of the history: a curve
after y edge and z cloud rounds is that of the history after `worth` y and `worth` z. What averaging itself costs
(`merge`, `drift`) stays. The form decides the size of every update, of vehicles and of edge servers, and adds a loss to
the error. A problem is planned for every combination of the tasks' choices; one that another of the same network is no
worse than in every respect is left out, since no plan with it is better.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import Protocol

from flcav.config import InputError
from flcav.network.plan import STORED_BITS, FormName
from flcav.optimization.curves.curves import Additive, Curve, Decay, SharedCurve
from flcav.optimization.problem import AllocationTask, Annotation, LocalSteps, Problem

MOST_CHOICES = 256  # combinations over all tasks
SAME = LocalSteps(factor=1.0)  # those of the history
CAREFUL = Annotation(box_s=0.0)  # that of the history


@dataclass(frozen=True)
class TaskChoice:
    """The choice of a plan for a task; None: the problem leaves none."""

    network: str | None
    annotation: str | None
    steps: LocalSteps | None
    form: FormName | None


def list_choices(task: AllocationTask, *, timed: bool, watched: bool) -> list[TaskChoice]:
    """Return the choices of a task, in its order, without those that another is no worse than in every respect.

    timed: whether training takes any of the time that the problem limits; watched: whether annotation does.
    """
    return [choice for variant in task.variants for choice in _list_own(variant, timed=timed, watched=watched)]


def _list_own(task: AllocationTask, *, timed: bool, watched: bool) -> list[TaskChoice]:
    """Return the choices of a task by its own network."""
    forms: list[FormName | None] = [*task.forms]
    ways: list[str | None] = [*task.annotations]
    every = [
        TaskChoice(task.network, way, steps, form)
        for way, steps, form in product(ways or [None], task.local_steps or (None,), forms or [None])
    ]

    def cost(choice: TaskChoice) -> tuple[float, ...]:
        steps = choice.steps or SAME
        bits, loss = (0.0, 0.0) if choice.form is None else (task.form_bits(choice.form), task.forms[choice.form].loss)
        how = CAREFUL if choice.annotation is None else task.annotations[choice.annotation]
        return how.box_s * watched, -how.worth, how.loss, steps.factor * timed, -steps.worth, bits, loss

    costs = [cost(choice) for choice in every]
    return [
        choice
        for number, (choice, own) in enumerate(zip(every, costs))
        if not any(
            all(a <= b for a, b in zip(other, own)) and (other != own or place < number)
            for place, other in enumerate(costs)
        )
    ]


def settle(task: AllocationTask, choice: TaskChoice) -> AllocationTask:
    """Return the task with the network, times, sizes and curves of `choice`, and nothing left to choose."""
    task = _take(task, choice.network)
    if choice.annotation is None and choice.steps is None and choice.form is None:
        return task
    factor = (choice.steps or SAME).factor
    share = 1.0 if choice.form is None else task.form_bits(choice.form) / STORED_BITS
    update = {
        "annotations": _left_annotation(task, choice.annotation),
        "local_steps": (),
        "forms": {},
        "train_s": factor * task.train_s,
        "vehicle_train_s": {name: factor * train_s for name, train_s in task.vehicle_train_s.items()},
        "model_mb": share * task.model_mb,
    }
    return task.model_copy(update=update | _chosen_curves(task, choice))


def _take(task: AllocationTask, network: str | None) -> AllocationTask:
    """Return the task by one of its networks, without alternatives."""
    if not task.alternatives:
        return task
    return next(each for each in task.variants if each.network == network).model_copy(update={"alternatives": ()})


def _left_annotation(task: AllocationTask, way: str | None) -> dict[str, Annotation]:
    """Return the one way of annotation that is left, its noise being in the curve."""
    return {} if way is None else {way: task.annotations[way].model_copy(update={"worth": 1.0, "loss": 0.0})}


def narrow(task: AllocationTask, told: "Told") -> AllocationTask:
    """Return the task with the choice of the samples and rounds that are done, and curves for it.

    Raises `InputError` where it is none of the task's, or is not told.
    """
    networks = [each.network for each in task.variants if each.network is not None]
    if (task.alternatives or told.network is not None) and told.network not in networks:
        raise _unknown(task, "network", told.network, networks)
    task = _take(task, told.network)
    choice = find_choice(task, told)
    for field, given, known, found in (
        ("annotation", told.annotation, [*task.annotations], choice.annotation is not None),
        ("local_steps", told.local_steps, [f"{each.factor:g}" for each in task.local_steps], choice.steps is not None),
        ("form", told.form, [*task.forms], choice.form is not None),
    ):
        if (known and not found) or (given is not None and not known):
            raise _unknown(task, field, given, known)
    left = {
        "annotations": _left_annotation(task, choice.annotation),
        "local_steps": () if choice.steps is None else (choice.steps.model_copy(update={"worth": 1.0}),),
        "forms": {} if choice.form is None else {choice.form: task.forms[choice.form].model_copy(update={"loss": 0.0})},
    }
    return task.model_copy(update=left | _chosen_curves(task, choice))


def _unknown(task: AllocationTask, field: str, given: object, known: Sequence[str]) -> InputError:
    told = "is not told" if given is None else f"= {given} is no choice"
    return InputError(f"progress.tasks.{task.name}.{field} {told} of the problem's: {', '.join(known) or 'none'}")


def settle_all(problem: Problem, choices: Sequence[TaskChoice]) -> Problem:
    """Return the problem with a choice for each of its tasks."""
    tasks = tuple(settle(task, choice) for task, choice in zip(problem.tasks, choices, strict=True))
    return problem.model_copy(update={"tasks": tasks})


def settle_first(problem: Problem) -> tuple[tuple[TaskChoice, ...], Problem]:
    """Return the first choice of every task, and the problem with them."""
    choices = tuple(
        TaskChoice(
            task.network,
            next(iter(task.annotations), None),
            next(iter(task.local_steps), None),
            next(iter(task.forms), None),
        )
        for task in problem.tasks
    )
    return choices, settle_all(problem, choices)


def list_settled(problem: Problem) -> Iterator[tuple[tuple[TaskChoice, ...], Problem]]:
    """Yield every combination of the tasks' choices, and the problem with it.

    Raises `InputError` where they are more than `MOST_CHOICES`.
    """
    timed = [
        problem.horizon_s is not None and (task.train_s > 0 or any(task.vehicle_train_s.values()))
        for task in problem.tasks
    ]
    watched = problem.annotation_s is not None
    options = [list_choices(task, timed=own, watched=watched) for task, own in zip(problem.tasks, timed, strict=True)]
    if (many := prod(map(len, options))) > MOST_CHOICES:
        raise InputError(
            f"networks, annotations, local_steps and forms: {many} combinations over all tasks, and {MOST_CHOICES} at "
            "most can be planned; name fewer"
        )
    for choices in product(*options):
        yield choices, settle_all(problem, choices)


class Told(Protocol):
    """Record of the choices that were taken for a task: its plan, or its progress."""

    @property
    def network(self) -> str | None: ...  # noqa: D102
    @property
    def annotation(self) -> str | None: ...  # noqa: D102
    @property
    def local_steps(self) -> float | None: ...  # noqa: D102
    @property
    def form(self) -> str | None: ...  # noqa: D102


def find_choice(task: AllocationTask, told: Told) -> TaskChoice:
    """Return the choice of a task by what a plan or its progress tells, as far as the task has it."""
    task = next((each for each in task.variants if each.network == told.network), task)
    return TaskChoice(
        task.network,
        next((name for name in task.annotations if name == told.annotation), None),
        next((each for each in task.local_steps if each.factor == told.local_steps), None),
        next((name for name in task.forms if name == told.form), None),
    )


def _chosen_curves(task: AllocationTask, choice: TaskChoice) -> dict[str, Curve | None]:
    """Return the curves of a task, by field, for a choice."""
    how = CAREFUL if choice.annotation is None else task.annotations[choice.annotation]
    loss = how.loss + (0.0 if choice.form is None else task.forms[choice.form].loss)
    curves = {name: getattr(task, name) for name in ("curve", "upper", "lower")}
    return {
        name: None if curve is None else _pace(curve, how.worth, (choice.steps or SAME).worth, loss)
        for name, curve in curves.items()
    }


def _pace(curve: Curve, sample: float, worth: float, loss: float) -> Curve:
    """Return the curve whose samples and rounds are worth `sample` and `worth` of those of `curve`, and `loss` more."""
    if isinstance(curve, SharedCurve):
        members = (each.model_copy(update={"curve": _pace(each.curve, sample, worth, loss)}) for each in curve.members)
        return curve.model_copy(update={"members": tuple(members)})
    update = {"floor": curve.floor + loss}
    if isinstance(curve, Additive):
        paces = {"pretrain": sample, "edge": worth, "cloud": worth}
        return curve.model_copy(
            update=update | {name: _hasten(getattr(curve, name), pace) for name, pace in paces.items()}
        )
    return curve.model_copy(update=update | {"pace": worth * curve.pace, "alpha": sample * curve.alpha})


def _hasten(decay: Decay, worth: float) -> Decay:
    """Return the decay whose value after x samples or rounds is that of `decay` after `worth` x."""
    return decay.model_copy(update={"a": decay.a * worth**-decay.b, "x0": decay.x0 / worth})
