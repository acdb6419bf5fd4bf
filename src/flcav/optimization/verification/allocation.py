"""Verification of a plan of MLGRA: costs, objective and dual bound recomputed from problem, plan and certificate.

Nothing of it is the solvers'. Costs are exact, of the decimals that the problem's floats are written with. Where labels
or accuracy are paid once with the first cloud round, plans without and with one are branches, each with its own dual.
"""

import json
from collections.abc import Sequence
from math import fsum

import numpy as np

from flcav.optimization.verification.dual_bounds import bound_largest, bound_weighted
from flcav.optimization.verification.record import NEAR, Verification, exact, judge, near
from flcav.optimization.verification.tasks import (
    QUANTITIES,
    Array,
    Data,
    VerifiedTask,
    error,
    least_cost,
    list_branches,
    read_tasks,
)

CURVES = "the learning curves, which are fitted"
FLEET = "the split over vehicles with names, their time within horizon_s, and a bound by that time"
SEARCH = "the search above the dual (its leaves, HiGHS' word): that no plan is below {:.9g}"


def verify_allocation(problem_json: str, plan_json: str, optimal: float = 1e-4) -> Verification:
    """Return the verification of a plan (`Allocation`) for a `Problem`, both as JSON text.

    `optimal`: largest gap of a plan whose status is optimal.
    """
    problem, plan = json.loads(problem_json), json.loads(plan_json)
    k, kind = problem["edge_rounds_per_cloud_round"], problem["objective"]
    lower, duals = plan["lower_bound"], plan.get("certificate", ())
    asked, budgets = read_tasks(problem, k)
    tasks = [own.calls.get(each.get("called"), own) for own, each in zip(asked, plan["tasks"], strict=True)]
    counts = [[each[name] for name in QUANTITIES] for each in plan["tasks"]]
    costs = [task.cost(own) for task, own in zip(tasks, counts, strict=True)]
    told = [plan["used_mb"].values(), *((each["wireless_mb"], each["wireline_mb"]) for each in plan["tasks"])]
    errors = [[float(error(curve, own, k)) for _, curve in task.curves] for task, own in zip(tasks, counts)]
    value = max(map(max, errors))
    if kind == "weighted":
        value = fsum(w * each for task, own in zip(tasks, errors) for (w, _), each in zip(task.curves, own))
    if kind == "area":
        corners = np.maximum(1 - np.concatenate(errors), 0)
        value = float(np.sin(2 * np.pi / len(corners)) / 2 * (corners @ np.roll(corners, 1)))
    spent = sum(costs, np.zeros(1, dtype=object))
    claims = {
        "the vehicles called": all(
            not own.calls or each["called"] in own.calls for own, each in zip(asked, plan["tasks"])
        ),
        "the limits": all(a <= n <= b for task, own in zip(tasks, counts) for n, (a, b) in zip(own, task.limits)),
        "the budgets": bool(np.all(spent <= budgets)),
        "the megabytes": all(near(float(a), b) for own, said in zip([spent, *costs], told) for a, b in zip(own, said)),
        "the objective": near(value, plan["objective"]),
    }
    trusted = [CURVES] + [FLEET] * any(each["uplink_mbps"] or each["vehicle_train_s"] for each in problem["tasks"])
    if kind == "area":
        claims["that there is no bound"] = lower is None and plan["gap"] is None and plan["status"] == "feasible"
        return judge(value, spent, None, claims, trusted)
    branches = [own for own in list_branches(asked) if np.all(least_cost(own) <= budgets)]
    proven = [_prove(kind, own, each, budgets, k) for own, each in zip(branches, duals)]
    bound = min([*proven, value]) if len(branches) == len(duals) else 0.0
    claims["the duals"] = len(branches) == len(duals) and all(
        found >= each["bound"] * (1 - 2 * NEAR) for found, each in zip(proven, duals)
    )
    claims["the lower bound"] = bound * (1 - 2 * NEAR) <= lower <= value * (1 + NEAR)
    claims["the gap"] = abs(plan["gap"] - ((value - lower) / lower if lower > 0 else value > 0)) <= NEAR
    claims["the status"] = plan["status"] == ("optimal" if plan["gap"] <= optimal else "feasible")
    trusted += [SEARCH.format(lower)] * (lower > bound * (1 + 2 * NEAR))
    return judge(value, spent, bound, claims, trusted)


def _prove(kind: str, tasks: Sequence[VerifiedTask], dual: Data, budgets: Array, k: int) -> float:
    multipliers = np.array([exact(each) for each in dual["multipliers"]])
    if len(multipliers) != len(budgets) or np.any(multipliers < 0):
        return 0.0
    if kind == "weighted":
        return bound_weighted(tasks, multipliers, budgets, k)
    return bound_largest(tasks, multipliers, dual["bound"], budgets, k)
