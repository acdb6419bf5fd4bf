"""Branching on the first cloud round and on the number of vehicles called.

An additive curve with a `merge` is not convex in the cloud rounds. It is convex without any, and from the first one on,
where the cost is part of its floor. Labels that are sent once, before the first cloud round (`labels_mb`), cost
megabytes in the same way: each such task has two branches. The number of vehicles called to the rounds of stage II
multiplies what a round costs and what it brings: a task has a branch for each number. The best plan of all branches is
the best plan of the problem, and the least of their lower bounds is a lower bound of it.
"""

from collections.abc import Callable, Iterator
from itertools import product
from math import prod
from typing import TypeVar

from flcav.config import InputError
from flcav.optimization.curves.curves import Additive, Curve, Effective, Federated, SharedCurve, split_regions
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.instance import Infeasible

T = TypeVar("T")
MOST_BRANCHING = 8  # tasks, each of which doubles the number of problems
MOST_CALLS = 2**MOST_BRANCHING  # combinations of numbers of vehicles


def solve_branches(problem: Problem, solve: Callable[[Problem], T]) -> list[T]:
    """Return the result of `solve` for each branch that has a plan; the first has the fewest cloud rounds.

    Raises `Infeasible`, that of the first branch, where none has a plan, and `InputError` where more than
    `MOST_BRANCHING` tasks have two branches, or vehicles can be called in more than `MOST_CALLS` ways.
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


def call_vehicles(task: AllocationTask, least: int, most: int, k: int) -> AllocationTask:
    """Return the task with `least` to `most` vehicles called to stage II, and curves for the data that `most` bring.

    The called vehicles of an edge server bring their share of its data, by `worth`. Stage III has all vehicles, so that
    the rest is learned in cloud rounds: z of them bring the share 1 - 1 / (z + 1) of it, which understates it for
    `k` > 1 edge rounds in each; for k = 0 no vehicle trains in them.
    """
    before = task.weigh_groups(max(task.edge_groups) if task.called is None else task.called[1])
    after = task.weigh_groups(most)
    shares = [one / all_ for one, all_ in zip(after, before, strict=True)]
    whole = sum(after) / sum(before)

    def share(curve: Curve | None) -> Curve | None:
        if isinstance(curve, Effective) and whole < 1:
            held = whole * curve.group_samples
            others = 0.0 if k == 0 else (1 - whole) / whole
            values = {name: getattr(curve, name) for name in ("floor", "a", "b", "alpha", "beta", "pace")}
            return Federated(model="federated", **values, group_samples=(held, held), gamma=others)
        if isinstance(curve, Federated):
            parts = shares if len(shares) == len(curve.group_samples) else [whole] * len(curve.group_samples)
            brought = tuple(part * held for part, held in zip(parts, curve.group_samples, strict=True))
            (own, others), (new_own, new_others) = split_regions(curve.group_samples), split_regions(brought)
            rest = curve.gamma * others + (own - new_own) * (k > 0)
            return curve.model_copy(
                update={"group_samples": brought, "gamma": rest / new_others if new_others else curve.gamma}
            )
        return curve

    update = {"called": (least, most), **{name: share(getattr(task, name)) for name in ("curve", "upper", "lower")}}
    return task.model_copy(update=update)


def list_calls(task: AllocationTask, k: int) -> Iterator[AllocationTask]:
    """Yield the task once per number of vehicles that a plan may call, the fewest first; else the task itself."""
    if task.called is None:
        yield task
        return
    for number in range(task.called[0], task.called[1] + 1):
        yield call_vehicles(task, number, number, k)


def _list_branches(problem: Problem) -> list[Problem]:
    choices = prod(1 if task.called is None else 1 + task.called[1] - task.called[0] for task in problem.tasks)
    if choices > MOST_CALLS:
        raise InputError(
            f"called: {choices} combinations of vehicles, and {MOST_CALLS} at most can be planned; narrow the ranges"
        )
    k = problem.edge_rounds_per_cloud_round
    options = [[each for called in list_calls(task, k) for each in _branch(called)] for task in problem.tasks]
    branching = sum(len(_branch(task)) > 1 for task in problem.tasks)
    if branching > MOST_BRANCHING:
        raise InputError(
            f"the first cloud round costs accuracy ('merge') or labels ('labels_mb') in {branching} tasks that may do "
            f"without it: at most {MOST_BRANCHING} can be planned together"
        )
    return [problem.model_copy(update={"tasks": tasks}) for tasks in product(*options)]


def _branch(task: AllocationTask) -> list[AllocationTask]:
    """Return the branches of a task without cloud rounds, and with one or more, where limits and curves allow them."""
    curves = _list_own(task.curve)
    if not (task.labels_mb or any(curve.merge for curve in curves)):
        return [task]
    least, most = task.limits.cloud_rounds
    branches = []
    if least == 0 and not any(curve.cloud.infinite_at_0 for curve in curves):
        branches.append(_limit(task, (0, 0), merged=False))
    if most > 0:
        branches.append(_limit(task, (max(least, 1), most), merged=True))
    return branches


def _list_own(curve: Curve) -> list[Additive]:
    members = [member.curve for member in curve.members] if isinstance(curve, SharedCurve) else [curve]
    return [member for member in members if isinstance(member, Additive)]


def _limit(task: AllocationTask, cloud_rounds: tuple[int, int], *, merged: bool) -> AllocationTask:
    """Return the task with other limits, and the cost of the first cloud round in its floor (`merged`) or left out."""
    limits = task.limits.model_copy(update={"cloud_rounds": cloud_rounds})
    return task.model_copy(update={"limits": limits, "curve": _settle(task.curve, merged)})


def _settle(curve: Curve, merged: bool) -> Curve:
    if isinstance(curve, Additive):
        return curve.model_copy(update={"floor": curve.floor + curve.merge * merged, "merge": 0.0})
    if isinstance(curve, SharedCurve):
        members = (member.model_copy(update={"curve": _settle(member.curve, merged)}) for member in curve.members)
        return curve.model_copy(update={"members": tuple(members)})
    return curve
