"""Choice of a plan for the rounds of each task: their local steps, and the form of their updates.

Both change what a round costs and what it brings. The local steps multiply a vehicle's training time, and a round is
worth other numbers of rounds of the history: a curve after y edge and z cloud rounds is that of the history after
`worth` y and `worth` z. What averaging itself costs (`merge`, `drift`) stays. The form decides the size of every
update, of vehicles and of edge servers, and adds a loss to the error. A problem is planned for every combination of the
tasks' choices; one that another is no worse than in every respect is left out, since no plan with it is better.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod

from flcav.config import InputError
from flcav.network.plan import STORED_BITS, FormName
from flcav.optimization.curves.curves import Additive, Curve, Decay, SharedCurve
from flcav.optimization.problem import AllocationTask, LocalSteps, Problem

MOST_CHOICES = 256  # combinations over all tasks
SAME = LocalSteps(factor=1.0)  # those of the history


@dataclass(frozen=True)
class RoundChoice:
    """The local steps of a task's rounds and the form of their updates; None: the problem leaves no choice."""

    steps: LocalSteps | None
    form: FormName | None


def list_choices(task: AllocationTask, *, timed: bool) -> list[RoundChoice]:
    """Return the choices of a task, in its order, without those that another is no worse than in every respect.

    timed: whether training takes any of the time that the problem limits.
    """
    forms: list[FormName | None] = [*task.forms]
    every = [RoundChoice(steps, form) for steps, form in product(task.local_steps or (None,), forms or [None])]

    def cost(choice: RoundChoice) -> tuple[float, ...]:
        steps = choice.steps or SAME
        bits, loss = (0.0, 0.0) if choice.form is None else (task.form_bits(choice.form), task.forms[choice.form].loss)
        return steps.factor * timed, -steps.worth, bits, loss

    costs = [cost(choice) for choice in every]
    return [
        choice
        for number, (choice, own) in enumerate(zip(every, costs))
        if not any(
            all(a <= b for a, b in zip(other, own)) and (other != own or place < number)
            for place, other in enumerate(costs)
        )
    ]


def settle(task: AllocationTask, choice: RoundChoice) -> AllocationTask:
    """Return the task with the time, the size of updates and the curves of `choice`, and nothing left to choose."""
    if choice == RoundChoice(None, None):
        return task
    factor = (choice.steps or SAME).factor
    share = 1.0 if choice.form is None else task.form_bits(choice.form) / STORED_BITS
    update = {
        "local_steps": (),
        "forms": {},
        "train_s": factor * task.train_s,
        "vehicle_train_s": {name: factor * train_s for name, train_s in task.vehicle_train_s.items()},
        "model_mb": share * task.model_mb,
    }
    return task.model_copy(update=update | _chosen_curves(task, choice))


def narrow(task: AllocationTask, factor: float | None, form: str | None) -> AllocationTask:
    """Return the task with the choice of the rounds that are done, and curves for it.

    Raises `InputError` where it is none of the task's, or is not told.
    """
    choice = find_choice(task, factor, form)
    for field, told, known, found in (
        ("local_steps", factor, [f"{each.factor:g}" for each in task.local_steps], choice.steps is not None),
        ("form", form, [*task.forms], choice.form is not None),
    ):
        if (known and not found) or (told is not None and not known):
            given = "is not told" if told is None else f"= {told} is no choice"
            raise InputError(
                f"progress.tasks.{task.name}.{field} {given} of the problem's: {', '.join(known) or 'none'}"
            )
    left = {
        "local_steps": () if choice.steps is None else (choice.steps.model_copy(update={"worth": 1.0}),),
        "forms": {} if choice.form is None else {choice.form: task.forms[choice.form].model_copy(update={"loss": 0.0})},
    }
    return task.model_copy(update=left | _chosen_curves(task, choice))


def settle_all(problem: Problem, choices: Sequence[RoundChoice]) -> Problem:
    """Return the problem with a choice for each of its tasks."""
    tasks = tuple(settle(task, choice) for task, choice in zip(problem.tasks, choices, strict=True))
    return problem.model_copy(update={"tasks": tasks})


def settle_first(problem: Problem) -> tuple[tuple[RoundChoice, ...], Problem]:
    """Return the first choice of every task, and the problem with them."""
    choices = tuple(
        RoundChoice(next(iter(task.local_steps), None), next(iter(task.forms), None)) for task in problem.tasks
    )
    return choices, settle_all(problem, choices)


def list_settled(problem: Problem) -> Iterator[tuple[tuple[RoundChoice, ...], Problem]]:
    """Yield every combination of the tasks' choices, and the problem with it.

    Raises `InputError` where they are more than `MOST_CHOICES`.
    """
    timed = [
        problem.horizon_s is not None and (task.train_s > 0 or any(task.vehicle_train_s.values()))
        for task in problem.tasks
    ]
    options = [list_choices(task, timed=own) for task, own in zip(problem.tasks, timed, strict=True)]
    if (many := prod(map(len, options))) > MOST_CHOICES:
        raise InputError(
            f"local_steps and forms: {many} combinations over all tasks, and {MOST_CHOICES} at most can be planned; "
            "name fewer"
        )
    for choices in product(*options):
        yield choices, settle_all(problem, choices)


def find_choice(task: AllocationTask, factor: float | None, form: str | None) -> RoundChoice:
    """Return the choice of a task by the factor of its local steps and the name of its form, as far as it has them."""
    steps = next((each for each in task.local_steps if each.factor == factor), None)
    return RoundChoice(steps, next((name for name in task.forms if name == form), None))


def _chosen_curves(task: AllocationTask, choice: RoundChoice) -> dict[str, Curve | None]:
    """Return the curves of a task, by field, for the rounds of a choice."""
    worth, loss = (choice.steps or SAME).worth, 0.0 if choice.form is None else task.forms[choice.form].loss
    curves = {name: getattr(task, name) for name in ("curve", "upper", "lower")}
    return {name: None if curve is None else _pace(curve, worth, loss) for name, curve in curves.items()}


def _pace(curve: Curve, worth: float, loss: float) -> Curve:
    """Return the curve whose rounds are worth `worth` of those of `curve`, and whose error is larger by `loss`."""
    if isinstance(curve, SharedCurve):
        members = (each.model_copy(update={"curve": _pace(each.curve, worth, loss)}) for each in curve.members)
        return curve.model_copy(update={"members": tuple(members)})
    update = {"floor": curve.floor + loss}
    if isinstance(curve, Additive):
        return curve.model_copy(
            update=update | {name: _hasten(getattr(curve, name), worth) for name in ("edge", "cloud")}
        )
    return curve.model_copy(update=update | {"pace": worth * curve.pace})


def _hasten(decay: Decay, worth: float) -> Decay:
    """Return the decay whose value after x rounds is that of `decay` after `worth` x."""
    return decay.model_copy(update={"a": decay.a * worth**-decay.b, "x0": decay.x0 / worth})
