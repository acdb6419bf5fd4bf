"""Verification of an MLGRA plan: costs, objective and dual bound recomputed from problem, plan and certificate.

It shares no code with the solvers. Costs are exact, of the decimals by which the problem's floats are written. Where
labels or accuracy are paid once with the first cloud round, plans without and with one are branches, each with a dual.
"""

import json
from collections.abc import Sequence
from math import floor, fsum, inf, nextafter
from typing import Any

import numpy as np

from flcav.optimization.verification.record import NEAR, Verification, exact, judge_claims, near
from flcav.optimization.verification.tasks import (
    QUANTITIES,
    STAGES,
    Array,
    Data,
    VerifiedTask,
    compute_drift,
    error,
    held_samples,
    least_cost,
    list_branches,
    read_tasks,
)

CURVES = "the learning curves, which are fitted"
FLEET = "the split over vehicles with names, their time within horizon_s, and a bound by that time"
SEARCH = "the search above the dual (its leaves, HiGHS' word): that no plan is below {:.9g}"


def verify_allocation(problem_json: str, plan_json: str, optimal: float = 1e-4) -> Verification:
    """Return the verification of a plan (`Allocation`) for a `Problem`, both as JSON text; costs in MB and s.

    `optimal` is the largest relative gap of a plan whose status is optimal.
    """
    problem, plan = json.loads(problem_json), json.loads(plan_json)
    k = problem["edge_rounds_per_cloud_round"]
    kind = problem["objective"]
    lower = plan["lower_bound"]
    duals = plan.get("certificate", ())
    read, budgets = read_tasks(problem, k)
    fields = ("network", "annotation", "local_steps", "form")
    chosen = [tuple(row.get(field) for field in fields) for row in plan["tasks"]]
    settled = [task.works.get(names, task) for task, names in zip(read, chosen, strict=True)]
    tasks = [task.calls.get(row.get("called"), task) for task, row in zip(settled, plan["tasks"], strict=True)]
    counts = [[row[name] for name in QUANTITIES] for row in plan["tasks"]]
    costs = [task.cost(row) for task, row in zip(tasks, counts, strict=True)]
    stated = [plan["used_mb"].values(), *((row["wireless_mb"], row["wireline_mb"]) for row in plan["tasks"])]
    errors = [[float(error(curve, row, k)) for _, curve in task.curves] for task, row in zip(tasks, counts)]
    value = max(map(max, errors))
    if kind == "weighted":
        value = fsum(w * loss for task, row in zip(tasks, errors) for (w, _), loss in zip(task.curves, row))
    if kind == "area":
        corners = np.maximum(1 - np.concatenate(errors), 0)
        value = float(np.sin(2 * np.pi / len(corners)) / 2 * (corners @ np.roll(corners, 1)))
    spent = sum(costs, np.zeros(1, dtype=object))
    claims = {
        "the choices": all(names in task.works for task, names in zip(read, chosen)),
        "the vehicles called": all(
            not task.calls or row["called"] in task.calls for task, row in zip(settled, plan["tasks"])
        ),
        "the limits": all(a <= n <= b for task, row in zip(tasks, counts) for n, (a, b) in zip(row, task.limits)),
        "the budgets": bool(np.all(spent <= budgets)),
        "the megabytes": all(
            near(float(a), b) for recomputed, said in zip([spent, *costs], stated) for a, b in zip(recomputed, said)
        ),
        "the annotators' time": problem.get("annotation_s") is None or near(float(spent[-1]), plan["annotation_s"]),
        "the objective": near(value, plan["objective"]),
    }
    trusted = [CURVES] + [FLEET] * any(task["uplink_mbps"] or task["vehicle_train_s"] for task in problem["tasks"])
    if kind == "area":
        claims["that there is no bound"] = lower is None and plan["gap"] is None and plan["status"] == "feasible"
        return judge_claims(value, spent, None, claims, trusted)
    branches = [branch for branch in list_branches(read) if np.all(least_cost(branch) <= budgets)]
    proven = [_prove(kind, branch, dual, budgets, k) for branch, dual in zip(branches, duals)]
    bound = min([*proven, value]) if len(branches) == len(duals) else 0.0
    claims["the duals"] = len(branches) == len(duals) and all(
        reached >= dual["bound"] * (1 - 2 * NEAR) for reached, dual in zip(proven, duals)
    )
    claims["the lower bound"] = bound * (1 - 2 * NEAR) <= lower <= value * (1 + NEAR)
    claims["the gap"] = abs(plan["gap"] - ((value - lower) / lower if lower > 0 else value > 0)) <= NEAR
    claims["the status"] = plan["status"] == ("optimal" if plan["gap"] <= optimal else "feasible")
    trusted += [SEARCH.format(lower)] * (lower > bound * (1 + 2 * NEAR))
    return judge_claims(value, spent, bound, claims, trusted)


def _prove(kind: str, tasks: Sequence[VerifiedTask], dual: Data, budgets: Array, k: int) -> float:
    multipliers = np.array([exact(each) for each in dual["multipliers"]])
    if len(multipliers) != len(budgets) or np.any(multipliers < 0):
        return 0.0
    if kind == "weighted":
        return bound_weighted(tasks, multipliers, budgets, k)
    return bound_largest(tasks, multipliers, dual["bound"], budgets, k)


Powers = list[tuple[float, float, float, Any]]  # gain, b, alpha, shift of gain (alpha x + shift)^(-b)

SUMS = 1 - 2.0**-45  # of a sum of few terms, none negative: less than its rounding leaves of it
BELOW = 1 - 1e-9  # of a level: choices whose error just reaches it, or rounds to it, are not below this


def bound_weighted(tasks: Sequence[VerifiedTask], multipliers: Array, budgets: Array, k: int) -> float:
    """Return the least Lagrangian at the `multipliers` (L,), by weak duality a lower bound on any plan's error."""
    least = []
    left = budgets - least_cost(tasks)
    for task in tasks:
        ranges, prices = _afford(task, left), (task.unit @ multipliers).astype(float)
        merged = ranges[2][1] > 0
        weight, curve = task.curves[0]
        paid = float(task.once @ multipliers) * merged
        paid += fsum(w * (curve_["floor"] + curve_.get("merge", 0.0) * merged) for w, curve_ in task.curves)
        if curve["model"] == "additive":
            for stage, price, (low, high) in zip(STAGES, prices, ranges):
                paid_by = "worth" if stage == "pretrain" else "pace"
                paces = (each.get(paid_by, 1.0) for _, each in task.curves)
                decays = [
                    (w * each[stage]["a"], each[stage]["b"], pace, each[stage]["x0"])
                    for pace, (w, each) in zip(paces, task.curves)
                ]
                paid += float(_bound_convex([each for each in decays if each[0] > 0], price, low, high))
        else:
            y, z = _pair(ranges)
            alpha = curve.get("worth", 1.0) * curve["alpha"]
            powers: Powers = [(weight * curve["a"], curve["b"], alpha, held_samples(curve, y, z, k))]
            rounds = weight * compute_drift(curve, z) + prices[1] * y + prices[2] * z
            paid += float(np.min(_bound_convex(powers, prices[0], *ranges[0]) + rounds))
        least.append(paid * SUMS)
    return nextafter(fsum((*least, -nextafter(float(multipliers @ budgets), inf))), -inf)


def bound_largest(tasks: Sequence[VerifiedTask], prices: Array, level: float, budgets: Array, k: int) -> float:
    """Return `level` times `BELOW` if all plans that keep to it cost more than `budgets` (L,) at `prices`, else 0."""
    least = []
    left = budgets - least_cost(tasks)
    for task in tasks:
        ranges = _afford(task, left)
        of_unit = (task.unit @ prices).astype(float)
        y, z = _pair(ranges)
        low, high = (np.full(len(y), float(edge)) for edge in (ranges[0][0], ranges[0][1] + 1))
        most = high[0]
        while np.any(low < high):  # the fewest samples that may suffice
            x = np.floor((low + high) / 2)
            worst = np.max([error(curve, (x, y, z), k) * (1 - _margin(curve)) for _, curve in task.curves], axis=0)
            low, high = np.where(worst <= level * BELOW, low, x + 1), np.where(worst <= level * BELOW, x, high)
        cost = low * of_unit[0] + y * of_unit[1] + z * of_unit[2] + (z > 0) * float(task.once @ prices)
        least.append(float(np.min(np.where(low < most, cost, inf))) * SUMS)
    return level * BELOW if fsum(least) * SUMS > nextafter(float(prices @ budgets), inf) else 0.0


def _afford(task: VerifiedTask, left: Array) -> list[tuple[int, int]]:
    """Return the limits with the most lowered to what is `left` (L,) while all else is at its least."""
    rooms = [min((floor(a / c) for a, c in zip(left, unit) if c > 0), default=inf) for unit in task.unit]
    return [(low, int(min(high, low + room))) for (low, high), room in zip(task.limits, rooms)]


def _bound_convex(powers: Powers, price: float, low: int, high: int) -> Array:
    """Return a lower bound of sum_p gain (alpha x + shift)^(-b) + price x over whole x, elementwise.

    It is the least value of the tangents at the first x from which on the sum does not fall, and at the x before it.
    """
    rounding = max((_rounding(b) for _, b, _, _ in powers), default=2.0**-45)

    def at(x: Array) -> tuple[Array, Array]:
        bases = [(gain, b, alpha, np.asarray(alpha * x + shift)) for gain, b, alpha, shift in powers]
        value = sum((gain * base**-b for gain, b, _, base in bases), price * x)
        return value, sum((gain * b * alpha * base ** (-b - 1) for gain, b, alpha, base in bases), 0.0 * x)

    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = (np.full(np.shape(powers[0][3]) if powers else (), float(edge)) for edge in (low, high))
        while np.any(first < last):
            x = np.floor((first + last) / 2)
            beyond = (first < last) & (at(x)[1] > price)  # where it is found, it stays
            first, last = np.where(beyond, x + 1, first), np.where(beyond, last, x)
        bounds = []
        for x, edge, side in ((first, high, 1), (np.maximum(first - 1, low), low, -1)):
            value, fall = at(x)
            slope = np.minimum(side * (price - fall) - rounding * (price + fall), 0.0)  # away from x, if it falls
            bounds.append(value * (1 - rounding) + np.where(x == edge, 0.0, slope * (edge - x) * side))
    return np.minimum(*bounds)


def _pair(ranges: Sequence[tuple[int, int]]) -> list[Array]:
    """Return every pair of edge and cloud rounds, as two arrays."""
    return [each.ravel() for each in np.meshgrid(*(np.arange(low, high + 1.0) for low, high in ranges[1:]))]


def _rounding(b: float) -> float:
    return (8 + 4 * b) * 2.0**-50


def _margin(curve: Data) -> float:
    stages = [curve[stage] for stage in STAGES if stage in curve] or [curve]
    return max(_rounding(each["b"]) for each in stages)
