"""An allocation problem as the verifier reads it: costs, limits, branches and learning curves of its tasks.

Costs [MB, s] are exact, of the decimals by which the problem's floats are written.
"""

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import product
from math import fsum, inf
from typing import Any, NamedTuple

import numpy as np

from flcav.optimization.verification.record import exact

Data = Mapping[str, Any]  # JSON values
Array = np.ndarray[Any, np.dtype[Any]]  # of floats, or (L,) of Fractions

QUANTITIES, STAGES = ("samples", "edge_rounds", "cloud_rounds"), ("pretrain", "edge", "cloud")
SLACK = 1 + Fraction(1, 10**12)  # of a budget: the rounding of a sum that is within it


class VerifiedTask(NamedTuple):
    """A task under L budgets: wireless and wireline uplink [MB], and where it is limited, time [s]."""

    curves: list[tuple[float, Data]]  # weight and curve of each member
    limits: list[list[int]]  # least and most samples, edge rounds, cloud rounds
    unit: Array  # (3, L) cost of one of each
    once: Array  # (L,) cost of the first cloud round
    calls: Mapping[int, Any] = {}  # the task with each number of vehicles that a plan may call, the fewest first

    def cost(self, counts: Sequence[int]) -> Array:
        """Return the cost (L,) of samples, edge rounds and cloud rounds."""
        return np.array(counts, dtype=object) @ self.unit + self.once * (counts[2] > 0)


def least_cost(tasks: Sequence[VerifiedTask]) -> Array:
    """Return the cost (L,) of the least quantities that the limits allow."""
    return sum((task.cost([low for low, _ in task.limits]) for task in tasks), np.zeros(1, dtype=object))


def read_tasks(problem: Data, k: int) -> tuple[list[VerifiedTask], Array]:
    """Return the tasks, and the budgets (L,), raised by the rounding that a plan's sums may have."""
    tasks = []
    budgets = list(problem["budgets_mb"].values())
    horizon_s = problem["horizon_s"]
    gains = [max((problem["performance"] or 0) - (each["performance_without"] or 0), 0) for each in problem["tasks"]]
    for task, gain in zip(problem["tasks"], gains):
        weight = task["weight"] if problem["performance"] is None else gain / sum(gains)
        curve = task["upper" if problem["robust"] else "curve"]
        members = curve.get("members") or [{"weight": 1.0, "curve": curve}]
        curves = [(weight * each["weight"] / sum(m["weight"] for m in members), each["curve"]) for each in members]
        names = task["uplink_mbps"] or task["vehicle_train_s"]
        limits = [[*task["limits"][name]] for name in QUANTITIES]
        limits[0][1] = min(limits[0][1], sum(task["samples_held"].get(name, inf) for name in names) if names else inf)
        limits[2][1] = min(limits[2][1], 1 if k == 0 else inf)
        for limit, stage in zip(limits, STAGES):  # where an error is infinite at 0
            infinite = (member[stage]["a"] > 0 == member[stage]["x0"] for _, member in curves if stage in member)
            limit[0] = max(limit[0], any(infinite))
        sent = task.get("exchange_mb") or task["model_mb"]
        sizes = (task["sample_mb"], task["model_mb"], sent, task.get("labels_mb") or 0, 0 if names else task["train_s"])
        sample, model, sent, labels, train_s = map(exact, sizes)
        cars, servers = sum(task["edge_groups"]), len(task["edge_groups"])
        rounds = [[cars * (sent + labels), 0, train_s], [k * cars * sent, servers * model, k * train_s]]
        costs = np.array([[sample, sample, 0], *rounds, [cars * labels, 0, 0]], dtype=object)
        read = VerifiedTask(curves, limits, costs[:3], costs[3])
        tasks.append(read._replace(calls=_list_calls(task, read, sent + labels, k)) if task.get("called") else read)
    budgets += [horizon_s] * (horizon_s is not None and any(task.unit[1, 2] for task in tasks))
    kept = slice(len(budgets))
    tasks = [_keep(task, kept) for task in tasks]
    return tasks, np.array([exact(budget) * SLACK for budget in budgets])


def _list_calls(task: Data, read: VerifiedTask, sent: Fraction, k: int) -> dict[int, VerifiedTask]:
    """Return the task by number of vehicles called: they pay the edge rounds, and bring their share of the data.

    The rest of the data comes with cloud rounds, where vehicles train in them.
    """
    (least, most), calls = task["called"], {}
    worth = task.get("worth") or [1.0] * max(task["edge_groups"])
    before = [fsum(worth[: min(most, size)]) for size in task["edge_groups"]]
    for number in range(least, most + 1):
        after = [fsum(worth[: min(number, size)]) for size in task["edge_groups"]]
        shares = [one / all_ for one, all_ in zip(after, before)]
        cars = sum(min(number, size) for size in task["edge_groups"])
        whole = fsum(after) / fsum(before)
        unit, curves = read.unit.copy(), []
        unit[1, 0] = cars * sent
        for weight, curve in read.curves:
            held = curve["group_samples"]
            by = [whole] if not isinstance(held, list) else shares if len(shares) == len(held) else [whole] * len(held)
            left = [(1 - share) * each for share, each in zip(by, np.atleast_1d(held))]
            curves.append((weight, {**curve, "left": fsum(left) / len(left), "trained": k > 0}))
        calls[number] = read._replace(curves=curves, unit=unit)
    return calls


def _keep(task: VerifiedTask, budgets: slice) -> VerifiedTask:
    """Return the task with costs under the budgets that exist only."""
    calls = {number: _keep(called, budgets) for number, called in task.calls.items()}
    return task._replace(unit=task.unit[:, budgets], once=task.once[budgets], calls=calls)


def list_branches(tasks: Sequence[VerifiedTask]) -> Iterator[tuple[VerifiedTask, ...]]:
    """Yield the tasks for every combination of vehicles called, and of limits without and with cloud rounds.

    The latter are two branches where the first cloud round has a cost that is paid once.
    """
    options = []
    for task in tasks:
        *others, (least, most) = task.limits
        once = any(task.once) or any(curve.get("merge") for _, curve in task.curves)
        parts = [[0, 0], [1, most]] if once and least == 0 < most else [[least, most]]
        called = task.calls.values() or (task,)
        options.append([variant._replace(limits=[*others, part]) for variant in called for part in parts])
    yield from product(*options)


def error(curve: Data, counts: Sequence[Any], k: int) -> Any:
    """Return a curve's error after `counts` (samples, edge rounds, cloud rounds), elementwise."""
    x, y, z = counts
    if curve["model"] == "additive":
        powers = ((curve[stage], each) for stage, each in zip(STAGES, counts))
        parts = [
            power["a"] * np.asarray(each + power["x0"], float) ** -power["b"]
            for power, each in powers
            if power["a"] > 0
        ]
        return curve["floor"] + curve["merge"] * (z > 0) + sum(parts)
    effective = curve["alpha"] * x + held_samples(curve, y, z, k)
    return curve["floor"] + compute_drift(curve, z) + curve["a"] * np.asarray(effective, float) ** -curve["b"]


def held_samples(curve: Data, y: Any, z: Any, k: int) -> Any:
    """Return the effective samples that edge rounds `y` and cloud rounds `z` bring, elementwise."""
    groups, t, left = np.atleast_1d(curve["group_samples"]), y + k * z, curve.get("left", 0.0)
    mean = fsum(groups) / len(groups)
    later = curve.get("gamma", 0.0) * mean * (len(groups) - 1) + left * curve.get("trained", False)
    return curve["beta"] * ((mean - left) * t / (t + 1) + later * z / (z + 1))


def compute_drift(curve: Data, z: Any) -> Any:
    """Return the change of the error by averaging over regions in `z` cloud rounds, elementwise."""
    drift = curve.get("drift", 0.0)
    return drift * z / (z + 1) if drift > 0 else -drift / (z + 1)
