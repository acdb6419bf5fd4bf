"""MLGRA on arrays against CVXPY with Clarabel on the same instances, in one run and one thread.

Continuous: the dual (`solve_two_budgets`) against the CVXPY call, which builds, compiles and solves, and Clarabel's
share of it. Whole: `minimise_weighted_error` with its proven gap. Every task has three stages with inverse-power
curves; both budgets bind.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

import cvxpy as cp
import numpy as np

from flcav.optimization.solvers.instance import Instance
from flcav.optimization.solvers.separable import Separable, room, solve_two_budgets
from flcav.optimization.solvers.weighted import minimise_weighted_error

REFERENCED = (30, 300, 3000)  # tasks
LARGE = 100_000
GAP = 1e-4  # relative, of whole plans


def instance(tasks: int, seed: int) -> Separable:
    """Return `tasks` random tasks of the sizes that vehicles send: samples 0.2-2 MB, models 0.5-60 MB."""
    rng = np.random.default_rng(seed)
    vehicles, servers, model_mb = rng.integers(2, 9, tasks), rng.integers(1, 4, tasks), rng.uniform(0.5, 60, tasks)
    cost = np.zeros((tasks, 3, 2))
    cost[:, 0] = rng.uniform(0.2, 2, (tasks, 1))
    cost[:, 1, 0] = cost[:, 2, 0] = vehicles * model_mb
    cost[:, 2, 1] = servers * model_mb
    a, b, x0 = (rng.uniform(low, high, 3 * tasks) for low, high in ((0.1, 1), (0.2, 0.9), (0.5, 2)))
    most = np.tile([5000.0, 100.0, 100.0], tasks)
    budget = 1000.0 * tasks * np.array([1.0, 0.25])
    made = Separable(a, b, x0, np.zeros(3 * tasks), most, cost.reshape(-1, 2), budget)
    return replace(made, high=np.minimum(most, room(made)))


def timed(work: Callable[[], object], repeats: int) -> float:
    """Return the median CPU seconds of `work`, after one call that is not counted."""
    taken = []
    for _ in range(repeats + 1):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return median(taken[1:])


def by_cvxpy(problem: Separable) -> tuple[float, float, float]:
    """Return the optimum, the CPU seconds of the whole call, and Clarabel's share of them by its own clock."""
    start, wall = time.process_time(), time.perf_counter()
    x = cp.Variable(len(problem.low))
    error = cp.sum(cp.multiply(problem.a, cp.exp(cp.multiply(-problem.b, cp.log(x + problem.x0)))))
    within: list[cp.Constraint] = [problem.cost.T @ x <= problem.budget, x >= problem.low, x <= problem.high]
    asked = cp.Problem(cp.Minimize(error), within)
    value: Any = asked.solve(solver=cp.CLARABEL, tol_gap_rel=1e-9, tol_gap_abs=1e-9, tol_feas=1e-9)
    call_s, wall_s = time.process_time() - start, time.perf_counter() - wall
    return float(value), call_s, call_s * float(asked.solver_stats.solve_time or 0.0) / wall_s


def measure(seed: int) -> dict[str, list[dict[str, float]]]:
    continuous, whole = [], []
    for tasks in REFERENCED:
        problem = instance(tasks, seed)
        ours = solve_two_budgets(problem)
        value, call_s, solver_s = by_cvxpy(problem)
        ours_s = timed(lambda problem=problem: solve_two_budgets(problem), 5)
        continuous.append(
            {
                "tasks": tasks,
                "difference": ours.bound / value - 1,
                "binding_links": int(np.count_nonzero(ours.multipliers)),
                "ours_ms": 1e3 * ours_s,
                "cvxpy_ms": 1e3 * call_s,
                "clarabel_ms": 1e3 * solver_s,
                "ratio": call_s / ours_s,
                "ratio_to_clarabel": solver_s / ours_s,
            }
        )
    problem = instance(LARGE, seed)
    continuous.append({"tasks": LARGE, "ours_ms": 1e3 * timed(lambda: solve_two_budgets(problem), 3)})
    for tasks in (3, *REFERENCED, LARGE):
        asked = Instance(instance(tasks, seed), effective=None, floor=0.0)
        found = minimise_weighted_error(asked, GAP)
        seconds = timed(lambda problem=asked: minimise_weighted_error(problem, GAP), 3)
        whole.append({"tasks": tasks, "ours_ms": 1e3 * seconds, "gap": found.gap(0.0)})
    return {"continuous": continuous, "whole": whole}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    figures = measure(arguments.seed)
    if arguments.json:
        print(json.dumps(figures, indent=1))
        return
    print("continuous optimum, CPU-ms of one thread")
    for row in figures["continuous"]:
        beside = ""
        if "ratio" in row:
            beside = (
                f"; CVXPY {row['cvxpy_ms']:.0f} ({row['ratio']:.0f} times), Clarabel alone {row['clarabel_ms']:.0f} "
                f"({row['ratio_to_clarabel']:.0f} times); objective differs by {row['difference']:.1e}; "
                f"{row['binding_links']} links bind"
            )
        print(f"{row['tasks']:7.0f} tasks: {row['ours_ms']:.2f}{beside}")
    print("whole plan with its proven gap")
    for row in figures["whole"]:
        print(f"{row['tasks']:7.0f} tasks: {row['ours_ms']:.2f}, gap {row['gap']:.1e}")


if __name__ == "__main__":
    main()
