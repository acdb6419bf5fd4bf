"""Maximisation of the area of the accuracy polygon: the tasks' accuracies on equally spaced axes of a radar chart.

With N >= 3 corners r_i the area is sin(2 pi / N) / 2 * sum_i r_i r_(i+1) (Wang et al., IEEE Network 37(3), 2023,
Fig. 6b). Its derivative with respect to a task's accuracy is proportional to the sum of its neighbours' accuracies.
Successive linearisation climbs it: the next plan is the one of least weighted error with the gradient as weights. As
the area is not concave, the climb has several starts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.geometry.arrays import Array
from flcav.optimization.curves.curves import SharedCurve
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Clock, build_instance
from flcav.optimization.solvers.weighted import minimise_weighted_error

STEPS = 12  # most steps from each start
EMPHASIS = 3.0  # weight of one corner in the start that emphasises it
MOST_EMPHASISED = 6  # corners up to which there is one more start for each
LEAST_WEIGHT = 1e-6  # of a corner


@dataclass(frozen=True)
class Polygon:
    """An integer plan with the area of its predicted accuracies."""

    x: Array  # (n,)
    area: float
    rates: Array  # (L,) increase of the area per unit of each budget


def area(accuracy: Array) -> float:
    """Return the area of the polygon whose corners are the accuracies (N,), in order; negative ones count as 0."""
    corners = np.maximum(accuracy, 0)
    return 0.5 * float(np.sin(2 * np.pi / len(corners)) * (corners @ np.roll(corners, -1)))


def maximise_area(problem: Problem, gap: float, clocks: Sequence[Clock] = ()) -> Polygon:
    """Return the plan of largest area among the local optima from several starts; nothing is proven.

    `gap` is the relative gap of each weighted problem, and the least relative gain of a step; `clocks` are as in
    `build_instance`. Raises `Infeasible` where no plan is within the budgets.
    """
    corners = sum(len(task.learners) for task in problem.tasks)
    starts = [np.ones(corners)]
    if corners <= MOST_EMPHASISED:
        starts += [1 + (EMPHASIS - 1) * np.eye(corners)[corner] for corner in range(corners)]
    return max((_climb(problem, start, gap, clocks) for start in starts), key=lambda found: found.area)


def _climb(problem: Problem, weights: Array, gap: float, clocks: Sequence[Clock]) -> Polygon:
    best = Polygon(np.zeros(0), -np.inf, np.zeros(2))
    for _ in range(STEPS):
        weighed = _weighed(problem, np.maximum(weights, LEAST_WEIGHT))
        found = minimise_weighted_error(build_instance(weighed, clocks), gap)
        accuracy = _accuracy(problem, found.x)
        reached = Polygon(found.x, area(accuracy), found.rates)
        if reached.area <= best.area * (1 + gap):
            return max(best, reached, key=lambda polygon: polygon.area)
        best = reached
        corners = np.maximum(accuracy, 0)
        weights = 0.5 * np.sin(2 * np.pi / len(corners)) * (np.roll(corners, 1) + np.roll(corners, -1))
    return best


def _accuracy(problem: Problem, x: Array) -> Array:
    k = problem.edge_rounds_per_cloud_round
    return 1 - np.array(
        [
            float(learner.curve.error(*counts, k=k))
            for task, counts in zip(problem.tasks, x.reshape(-1, 3))
            for learner in task.learners
        ]
    )


def _weighed(problem: Problem, weights: Array) -> Problem:
    """Return `problem` with other `weights`, one per learner, in order."""
    left = iter(weights.tolist())
    tasks = []
    for task in problem.tasks:
        task_weights = [next(left) for _ in task.learners]
        update: dict[str, object] = {"weight": sum(task_weights)}
        if isinstance(task.curve, SharedCurve):
            members = (member.model_copy(update={"weight": w}) for member, w in zip(task.curve.members, task_weights))
            update["curve"] = task.curve.model_copy(update={"members": tuple(members)})
        tasks.append(task.model_copy(update=update))
    return problem.model_copy(update={"tasks": tuple(tasks)})
