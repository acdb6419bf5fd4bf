"""Problems whose first cloud rounds cost accuracy, as problems in which none does.

An additive curve with a `merge` is not convex in the cloud rounds. It is convex without any, and from the first on,
where the cost is part of its floor. Labels that are sent once before the first cloud round (`labels_mb`) cost megabytes
in the same way. So each such task has two branches. The best plan of all branches is the best plan of the problem, and
the least of their lower bounds is one.
"""

from collections.abc import Callable
from itertools import product
from typing import TypeVar

from flcav.config import InputError
from flcav.optimization.curves.curves import Additive, Curve, SharedCurve
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.instance import Infeasible

T = TypeVar("T")
MOST_BRANCHING = 8  # tasks, each of which doubles the number of problems


def solve_branches(problem: Problem, solve: Callable[[Problem], T]) -> list[T]:
    """Return the result of `solve` for each branch that has a plan; the first has the fewest cloud rounds.

    Raises `Infeasible`, that of the first branch, where none has a plan, and `InputError` for more than
    `MOST_BRANCHING` tasks with two branches.
    """
    found: list[T] = []
    refused: list[Infeasible] = []
    for branch in _list_branches(problem):
        try:
            found.append(solve(branch))
        except Infeasible as error:
            refused.append(error)
    if not found:
        raise refused[0]
    return found


def _list_branches(problem: Problem) -> list[Problem]:
    options = [_branch(task) for task in problem.tasks]
    branching = sum(len(each) > 1 for each in options)
    if branching > MOST_BRANCHING:
        raise InputError(
            f"the first cloud round costs accuracy ('merge') or labels ('labels_mb') in {branching} tasks that may do "
            f"without it: at most {MOST_BRANCHING} can be planned together"
        )
    return [problem.model_copy(update={"tasks": tasks}) for tasks in product(*options)]


def _branch(task: AllocationTask) -> list[AllocationTask]:
    """Return the task without cloud rounds, and with one or more, as far as its limits and curves allow either."""
    own = _list_own(task.curve)
    if not (task.labels_mb or any(curve.merge for curve in own)):
        return [task]
    least, most = task.limits.cloud_rounds
    branches = []
    if least == 0 and not any(curve.cloud.infinite_at_0 for curve in own):
        branches.append(_limit(task, (0, 0), merged=False))
    if most > 0:
        branches.append(_limit(task, (max(least, 1), most), merged=True))
    return branches


def _list_own(curve: Curve) -> list[Additive]:
    members = [member.curve for member in curve.members] if isinstance(curve, SharedCurve) else [curve]
    return [each for each in members if isinstance(each, Additive)]


def _limit(task: AllocationTask, cloud_rounds: tuple[int, int], *, merged: bool) -> AllocationTask:
    """Return the task with other limits, and with the cost of the first cloud round paid (`merged`) or left out."""
    limits = task.limits.model_copy(update={"cloud_rounds": cloud_rounds})
    return task.model_copy(update={"limits": limits, "curve": _settle(task.curve, merged)})


def _settle(curve: Curve, merged: bool) -> Curve:
    if isinstance(curve, Additive):
        return curve.model_copy(update={"floor": curve.floor + curve.merge * merged, "merge": 0.0})
    if isinstance(curve, SharedCurve):
        members = (member.model_copy(update={"curve": _settle(member.curve, merged)}) for member in curve.members)
        return curve.model_copy(update={"members": tuple(members)})
    return curve
