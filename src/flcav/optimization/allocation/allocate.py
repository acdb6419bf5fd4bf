"""MLGRA (multi-layer graph resource allocation): samples, edge rounds and cloud rounds per task under uplink budgets.

Plans are in integers and within both budgets. The objective is the weighted error (`solvers.weighted`), the largest
error (`solvers.fairness`), or the area of the accuracy polygon (`solvers.area`), which is maximised. Plans for the
first two have a proven lower bound. Source: Wang et al., IEEE Network 37(3), 2023, solved exactly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flcav.config import InputError
from flcav.geometry.arrays import Array
from flcav.interface.notebook import Displayed
from flcav.network.ledger import LinkMegabytes
from flcav.optimization.allocation.choices import TaskChoice, find_choice, list_settled, settle_all
from flcav.optimization.curves.curves import Curve, SharedCurve
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.area import area, maximise_area
from flcav.optimization.solvers.branches import call_vehicles, solve_branches
from flcav.optimization.solvers.fairness import minimise_largest_error
from flcav.optimization.solvers.instance import Clock, Infeasible, Instance, build_instance, price_counts, shared_clock
from flcav.optimization.solvers.weighted import minimise_weighted_error

MB_PER_GB = 1000.0
EXACT = 1e-9  # gap for problems of few tasks
EXACT_TASKS = 4  # most tasks that are few
COARSE = 1.0  # gap of the first plan of each choice; its bound tells whether the choice is worth a better one
AREA_GAP = 1e-4  # least gap for the weighted problems within the search for a large area
NO_CERTIFICATE = "the area is not concave in the plan: this is the best of several local optima, with no certificate"


@dataclass(frozen=True)
class LearnerError:
    """The predicted error of a member of a cluster."""

    name: str
    predicted_error: float


@dataclass(frozen=True)
class TaskAllocation:
    """The plan of a task: its samples and rounds, predicted error and uplink cost."""

    name: str
    samples: int
    edge_rounds: int
    cloud_rounds: int
    predicted_error: float  # of a cluster: the weighted mean of its members' errors
    wireless_mb: float
    wireline_mb: float
    upper_error: float | None = None  # of robust plans: predicted by the upper band
    members: tuple[LearnerError, ...] = ()  # of a cluster
    called: int | None = None  # vehicles of each edge server in the rounds of stage II; None: all
    accuracy_low: float | None = None  # predicted by the upper band of the error; None where the task has none
    accuracy_high: float | None = None  # predicted by its lower band
    local_steps: float | None = None  # times those of the history, where the problem leaves the choice
    form: str | None = None  # of the updates, where the problem leaves the choice
    network: str | None = None  # by which the task is learned, where the problem leaves the choice
    annotation: str | None = None  # of its samples, where the problem leaves the choice

    def describe_choices(self) -> str:
        """Return network, annotation, local steps and form of updates that a plan has chosen; "" without a choice."""
        times = f"{self.local_steps:g} times " if self.local_steps not in (None, 1) else ""
        steps = "" if self.local_steps is None else f"{times}the local steps of the history"
        form = f"updates in {self.form}" if self.form else ""
        annotation = f"{self.annotation} annotation" if self.annotation else ""
        return ", ".join(filter(None, (self.network, annotation, steps, form)))

    def describe_accuracy(self) -> str:
        """Return the predicted accuracy with its band, as far as that is known; the error has two digits in it."""
        decimals = 2 + (self.predicted_error < 0.1) + (self.predicted_error < 0.01)
        told, *band = (
            "" if each is None else f"{each:.{decimals}f}"
            for each in (max(1 - self.predicted_error, 0.0), self.accuracy_low, self.accuracy_high)
        )
        return told + (f" ({' to '.join(filter(None, band))}{' or more' * (not band[1])})" if band[0] else "")


@dataclass(frozen=True)
class Dual:
    """A solution of the Lagrangian dual over integer plans, which proves a lower bound by itself.

    For the weighted error the bound is the least Lagrangian, sum of errors + multipliers * (cost - budget). For the
    largest error it is a level: at prices equal to the multipliers, every plan below it costs more than the budgets.
    """

    multipliers: tuple[float, ...]  # (L,) per unit of each budget: wireless, wireline [MB], then of clocks [s]
    bound: float


@dataclass(frozen=True)
class Allocation(Displayed):
    """A plan for all tasks and its certificate."""

    status: str  # optimal: within the gap asked for; feasible: the gap is wider, or there is none
    objective: (
        float  # weighted: weighted sum of the errors; max-min: largest error; area: of the accuracy polygon, maximised
    )
    lower_bound: float | None  # proven: no plan has less; None for the area
    gap: float | None  # (objective - lower_bound) / lower_bound
    tasks: tuple[TaskAllocation, ...]
    used_mb: LinkMegabytes
    marginal_error_per_gb: LinkMegabytes  # derivative by each budget, per 1000 MB: see `allocate`
    busy_s: float | None = None  # time of the busiest vehicle, where horizon_s limits what vehicles train
    annotation_s: float | None = None  # time of annotators, where the problem limits it
    note: str | None = None
    warnings: tuple[str, ...] = ()
    certificate: tuple[Dual, ...] = ()  # of each branch that has a plan (`solve_branches`): the least bound holds


@dataclass(frozen=True)
class _Best:
    x: Array
    objective: float
    lower: float | None
    rates: Array
    dual: Dual | None
    branch: Problem | None = None


def allocate(problem: Problem, *, gap: float = 1e-4, clocks: Sequence[Clock] = ()) -> Allocation:
    """Return the best plan within both budgets, with its certificate: MLGRA of Wang et al., IEEE Network 37(3), 2023.

    It is sought to a relative `gap`, of at most 1e-9 for up to `EXACT_TASKS` tasks. Robust plans minimise the upper
    bands of the learning curves. `marginal_error_per_gb` is the derivative of the continuous optimum with respect to
    each budget, times 1000 MB: a shadow price at these budgets, not a forecast of the gain from 1000 MB more, for which
    see `budget_sweep.compute_savings`. Only the problem's `shared_clock` and `clocks` limit time; for the time of named
    vehicles see `fleet.allocate_fleet`. Raises `Infeasible`, naming the budget, the cost of the least plan within the
    limits and the excess, and `InputError` where the solver cannot handle the problem's numbers.

    >>> from flcav import allocate, load_problem
    >>> plan = allocate(load_problem("recipes/allocation/objects.yaml"))
    >>> plan.status, plan.tasks[0].name, plan.used_mb.wireless_mb <= 4000
    ('optimal', 'objects', True)
    """
    if not isinstance(problem, Problem):
        raise InputError("allocate: a problem is wanted; flcav.load_problem(path) reads one")
    settled = [*list_settled(problem)]
    sought = gap if len(problem.tasks) > EXACT_TASKS else min(gap, EXACT)
    first = sought if len(settled) == 1 or problem.objective == "area" else COARSE
    found: dict[int, Allocation] = {}  # by place in `settled`
    refused: list[Infeasible] = []
    for place, (choices, each) in enumerate(settled):
        try:
            found[place] = name_choices(_allocate(each, first, gap, clocks), choices)
        except Infeasible as error:
            refused.append(error)
    if not found:
        raise refused[0]
    for place in sorted(found, key=lambda place: found[place].objective) if first > sought else ():
        choices, each = settled[place]
        if (found[place].lower_bound or 0.0) < min(plan.objective for plan in found.values()):
            found[place] = name_choices(_allocate(each, sought, gap, clocks), choices)
    return join_plans(problem, [*found.values()], gap)


def name_choices(plan: Allocation, choices: Sequence[TaskChoice]) -> Allocation:
    """Return the plan with the choice named in each of its tasks."""
    return replace(plan, tasks=name_in_tasks(plan.tasks, choices))


def name_in_tasks(plans: Sequence[TaskAllocation], choices: Sequence[TaskChoice]) -> tuple[TaskAllocation, ...]:
    """Return the tasks' plans with their choices."""
    return tuple(
        replace(
            plan,
            local_steps=None if choice.steps is None else choice.steps.factor,
            form=choice.form,
            network=choice.network,
            annotation=choice.annotation,
        )
        for plan, choice in zip(plans, choices, strict=True)
    )


def settle_plan(problem: Problem, plans: Sequence[TaskAllocation]) -> Problem:
    """Return the problem with what `plans`, one per task, have chosen."""
    choices = (find_choice(task, plan) for task, plan in zip(problem.tasks, plans, strict=True))
    return settle_all(problem, tuple(choices))


def join_plans(
    problem: Problem, found: Sequence[Allocation], gap: float, certificate: tuple[Dual, ...] = ()
) -> Allocation:
    """Return the best of the plans of all choices: no plan of the problem is below the least of their bounds.

    It is optimal where it is within `gap` of that. certificate: of all choices; default: those of the plans.
    """
    best = (max if problem.objective == "area" else min)(found, key=lambda plan: plan.objective)
    if len(found) == 1:
        return replace(best, certificate=certificate or best.certificate)
    bounds = [plan.lower_bound for plan in found if plan.lower_bound is not None]
    lower = min(bounds) if bounds else None
    achieved = None if lower is None else relative_gap(best.objective, lower)
    return replace(
        best,
        status="optimal" if achieved is not None and achieved <= gap else "feasible",
        lower_bound=lower,
        gap=achieved,
        certificate=certificate or tuple(dual for plan in found for dual in plan.certificate),
    )


def _allocate(problem: Problem, sought: float, gap: float, clocks: Sequence[Clock]) -> Allocation:
    """Return the best plan, to a relative gap `sought`, of a problem without choices."""
    resolved = resolve_problem(problem)
    method = _METHODS[problem.objective]
    solved = solve_branches(
        resolved, lambda branch: replace(method(branch, build_instance(branch, clocks), sought, clocks), branch=branch)
    )
    best = (max if problem.objective == "area" else min)(solved, key=lambda plan: plan.objective)
    tasks = build_task_plans(_call(problem, best.branch or resolved), best.x)
    bounds = [plan.lower for plan in solved if plan.lower is not None]
    lower = min(*bounds, best.objective) if bounds else None
    achieved = None if lower is None else relative_gap(best.objective, lower)
    return Allocation(
        status="optimal" if achieved is not None and achieved <= gap else "feasible",
        objective=best.objective,
        lower_bound=lower,
        gap=achieved,
        tasks=tasks,
        used_mb=sum_prices(tasks),
        marginal_error_per_gb=LinkMegabytes(*(MB_PER_GB * max(float(rate), 0.0) for rate in best.rates[:2])),
        busy_s=_busy_s(resolved, tasks),
        annotation_s=_annotation_s(resolved, tasks),
        note=NO_CERTIFICATE if lower is None else None,
        warnings=(*_idle_horizon(problem), *_beyond(problem, tasks), *_unmeasured(problem, tasks)),
        certificate=tuple(plan.dual for plan in solved if plan.dual is not None),
    )


def _busy_s(problem: Problem, plans: Sequence[TaskAllocation]) -> float | None:
    """Return the time [s] on the problem's `shared_clock`; None where it has none."""
    clock = shared_clock(problem)
    k = problem.edge_rounds_per_cloud_round
    if clock is None:
        return None
    return sum(train_s * (plan.edge_rounds + k * plan.cloud_rounds) for train_s, plan in zip(clock.per_round, plans))


def _annotation_s(problem: Problem, plans: Sequence[TaskAllocation]) -> float | None:
    """Return the time of annotators [s]; None where the problem does not limit it."""
    if problem.annotation_s is None:
        return None
    return sum(task.annotate_s * plan.samples for task, plan in zip(problem.tasks, plans, strict=True))


def _call(problem: Problem, branch: Problem) -> Problem:
    """Return the problem with as many vehicles called as in `branch`, one of its branches."""
    tasks = tuple(
        task if chosen.called is None else call_vehicles(task, *chosen.called, problem.edge_rounds_per_cloud_round)
        for task, chosen in zip(problem.tasks, branch.tasks, strict=True)
    )
    return problem.model_copy(update={"tasks": tasks})


def relative_gap(objective: float, lower: float) -> float:
    """Return the relative gap (objective - lower) / lower to the bound `lower`; for a bound of 0, 0 or 1."""
    return (objective - lower) / lower if lower > 0 else float(objective > 0)


def resolve_problem(problem: Problem) -> Problem:
    """Return the problem to solve: with upper bands as curves if it is robust, and importances as weights if given.

    The importance of a task is the performance lost when it is left out, `performance` - `performance_without`, at
    least 0; importances are scaled to sum to 1.
    """
    tasks = problem.tasks
    if problem.robust:
        tasks = tuple(task.model_copy(update={"curve": task.upper}) for task in tasks)
    if problem.performance is not None:
        lost = np.array([problem.performance - float(task.performance_without or 0.0) for task in tasks])
        lost = np.maximum(lost, 0) / np.maximum(lost, 0).sum()
        tasks = tuple(task.model_copy(update={"weight": float(weight)}) for task, weight in zip(tasks, lost))
    return problem.model_copy(update={"tasks": tasks})


def build_task_plans(problem: Problem, x: Array) -> tuple[TaskAllocation, ...]:
    """Return the tasks' plans for x (3N,): samples, edge rounds and cloud rounds of the tasks, in order."""
    return tuple(_task_plan(problem, task, row) for task, row in zip(problem.tasks, x.reshape(-1, 3)))


def _task_plan(problem: Problem, task: AllocationTask, row: Array) -> TaskAllocation:
    samples, edge_rounds, cloud_rounds = (int(count) for count in row)
    cost = price_counts(problem, task, (samples, edge_rounds, cloud_rounds))

    def error(curve: Curve) -> float:
        return float(curve.error(samples, edge_rounds, cloud_rounds, problem.edge_rounds_per_cloud_round))

    def accuracy(curve: Curve | None, bound: Callable[[float, float], float]) -> float | None:
        """Return the accuracy by a band's edge, which the predicted one is not beyond."""
        return None if curve is None else max(bound(1 - error(curve), 1 - error(task.curve)), 0.0)

    members = [LearnerError(each.name, error(each.curve)) for each in task.learners]
    return TaskAllocation(
        *(task.name, samples, edge_rounds, cloud_rounds, error(task.curve), cost.wireless_mb, cost.wireline_mb),
        upper_error=error(task.upper) if problem.robust and task.upper is not None else None,
        members=tuple(members) if isinstance(task.curve, SharedCurve) else (),
        called=None if task.called is None else task.called[1],
        accuracy_low=accuracy(task.upper, min),
        accuracy_high=accuracy(task.lower, max),
    )


def sum_prices(plans: tuple[TaskAllocation, ...]) -> LinkMegabytes:
    """Return the total cost of the plans on each link [MB]."""
    return LinkMegabytes(sum(plan.wireless_mb for plan in plans), sum(plan.wireline_mb for plan in plans))


def weighted_error(problem: Problem, plans: Sequence[TaskAllocation]) -> float:
    """Return the weighted sum of the predicted errors, for robust plans of the upper errors."""
    errors = (plan.predicted_error if plan.upper_error is None else plan.upper_error for plan in plans)
    return sum(task.weight * error for task, error in zip(problem.tasks, errors, strict=True))


def evaluate_objective(problem: Problem, plans: Sequence[TaskAllocation]) -> float:
    """Return the value of the problem's objective for the plans: weighted error, largest error or area."""
    if problem.objective == "weighted":
        return weighted_error(problem, plans)
    counts = [(plan.samples, plan.edge_rounds, plan.cloud_rounds) for plan in plans]
    k = problem.edge_rounds_per_cloud_round
    errors = [
        float(learner.curve.error(*row, k=k)) for task, row in zip(problem.tasks, counts) for learner in task.learners
    ]
    return max(errors) if problem.objective == "max-min" else area(1 - np.array(errors))


def _idle_horizon(problem: Problem) -> tuple[str, ...]:
    """Return a warning where the problem has a horizon but nothing in it takes time."""
    if problem.horizon_s is None or any(
        task.uplink_mbps or task.train_s or task.vehicle_train_s for task in problem.tasks
    ):
        return ()
    return (f"horizon_s = {problem.horizon_s:g} limits nothing: no task has train_s, vehicle_train_s or uplink_mbps",)


def _beyond(problem: Problem, plans: tuple[TaskAllocation, ...]) -> tuple[str, ...]:
    """Return a warning for every quantity planned beyond the range in which its curve was measured."""
    return tuple(
        f"task {task.name!r}: {getattr(plan, name)} {name.replace('_', ' ')} are beyond the {most:g} that its curve "
        "was measured to"
        for task, plan in zip(problem.tasks, plans)
        for name in ("samples", "edge_rounds", "cloud_rounds")
        if (most := getattr(task.measured, name)) is not None and getattr(plan, name) > most
    )


def _unmeasured(problem: Problem, plans: tuple[TaskAllocation, ...]) -> tuple[str, ...]:
    """Return a warning for each task with 0 edge rounds whose curve has a history in which they do not vary."""
    told = []
    for task, plan in zip(problem.tasks, plans):
        known = task.measured.model_dump(exclude_none=True)
        if known and "edge_rounds" not in known and plan.edge_rounds == 0:
            why = "has none" if task.limits.edge_rounds[1] == 0 else "has none, or always as many"
            told.append(
                f"task {task.name!r}: 0 edge rounds, as the history of its curve {why}: what they bring is not known"
            )
    return tuple(told)


def _weighted(problem: Problem, made: Instance, gap: float, _clocks: Sequence[Clock]) -> _Best:
    found = minimise_weighted_error(made, gap)
    objective = weighted_error(problem, build_task_plans(problem, found.x))
    root = made.minimise_lagrangian(found.multipliers)[1] + made.floor
    return _Best(found.x, objective, found.bound + made.floor, found.rates, _dual(found.multipliers, root))


def _fair(problem: Problem, made: Instance, gap: float, _clocks: Sequence[Clock]) -> _Best:
    found = minimise_largest_error(problem, made, gap)
    return _Best(found.x, found.level, found.bound, found.rates, _dual(found.prices, found.root))


def _area(problem: Problem, made: Instance, gap: float, clocks: Sequence[Clock]) -> _Best:
    found = maximise_area(problem, max(gap, AREA_GAP), clocks)
    return _Best(found.x, found.area, None, found.rates, None)


def _dual(multipliers: Array, bound: float) -> Dual:
    return Dual(tuple(map(float, multipliers)), float(bound))


_METHODS = {"weighted": _weighted, "max-min": _fair, "area": _area}
