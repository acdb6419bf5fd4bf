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

BITS = {"float32": 32, "fp16": 16, "int8": 8, "int4": 4, "top-k": 64}  # of a parameter that is sent
QUANTITIES, STAGES = ("samples", "edge_rounds", "cloud_rounds"), ("pretrain", "edge", "cloud")
Choice = tuple[str | None, str | None, float | None, str | None]  # network, annotation, local steps, form of updates
CAREFUL: Data = {"box_s": 0, "worth": 1.0, "loss": 0.0}  # annotation as in the history, of no limited time
SLACK = 1 + Fraction(1, 10**12)  # of a budget: the rounding of a sum that is within it


class VerifiedTask(NamedTuple):
    """A task under L budgets: uplink, wireless and wireline [MB]; where limited, vehicles' and annotators' time [s]."""

    curves: list[tuple[float, Data]]  # weight and curve of each member
    limits: list[list[int]]  # least and most samples, edge rounds, cloud rounds
    unit: Array  # (3, L) cost of one of each
    once: Array  # (L,) cost of the first cloud round
    calls: Mapping[int, Any] = {}  # the task with each number of vehicles that a plan may call, the fewest first
    works: Mapping[Choice, Any] = {}  # with each choice that a plan may make

    def cost(self, counts: Sequence[int]) -> Array:
        """Return the cost (L,) of samples, edge rounds and cloud rounds."""
        return np.array(counts, dtype=object) @ self.unit + self.once * (counts[2] > 0)


def least_cost(tasks: Sequence[VerifiedTask]) -> Array:
    """Return the cost (L,) of the least quantities that the limits allow."""
    return sum((task.cost([low for low, _ in task.limits]) for task in tasks), np.zeros(1, dtype=object))


def read_tasks(problem: Data, k: int) -> tuple[list[VerifiedTask], Array]:
    """Return the tasks, and the budgets (L,), raised by the rounding that a plan's sums may have."""
    budgets = list(problem["budgets_mb"].values())
    horizon_s = problem["horizon_s"]
    tasks, timed = [], False
    gains = [max((problem["performance"] or 0) - (each["performance_without"] or 0), 0) for each in problem["tasks"]]
    for task, gain in zip(problem["tasks"], gains):
        weight = task["weight"] if problem["performance"] is None else gain / sum(gains)
        works = {}
        for variant in (task, *task.get("alternatives", ())):
            own, takes_time = _read_variant(problem, variant, weight, k)
            works |= own
            timed |= takes_time
        tasks.append(next(iter(works.values()))._replace(works=works))
    watched = problem.get("annotation_s") is not None
    kept = [0, 1, *([2] if horizon_s is not None and timed else []), *([3] if watched else [])]
    limits = [*budgets, horizon_s, problem.get("annotation_s")]
    tasks = [_keep(task, kept) for task in tasks]
    return tasks, np.array([exact(limits[column]) * SLACK for column in kept])


def _read_variant(problem: Data, task: Data, weight: float, k: int) -> tuple[dict[Choice, VerifiedTask], bool]:
    """Return the task by its own network, with each of its choices; and whether its rounds take a vehicle's time."""
    timed = False
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
    works = {}
    for way, factor, pace, form, share, loss in _list_works(task, problem):
        how = task.get("annotations", {}).get(way) or CAREFUL
        paced: list[tuple[float, Data]] = [
            (
                w,
                {
                    **own,
                    "floor": own["floor"] + loss + how["loss"],
                    "pace": pace * own.get("pace", 1.0),
                    "worth": how["worth"],
                },
            )
            for w, own in curves
        ]
        model = exact(task["model_mb"]) * share
        sizes = (task["sample_mb"], task.get("exchange_mb") or model, task.get("labels_mb") or 0)
        sample, sent, labels = map(exact, sizes)
        annotate_s = exact(task.get("boxes", 1.0)) * exact(how["box_s"])
        train_s = exact(0 if names else task["train_s"]) * exact(factor or 1)
        timed |= train_s > 0
        cars, servers = sum(task["edge_groups"]), len(task["edge_groups"])
        rounds = [[cars * (sent + labels), 0, train_s, 0], [k * cars * sent, servers * model, k * train_s, 0]]
        costs = np.array([[sample, sample, 0, annotate_s], *rounds, [cars * labels, 0, 0, 0]], dtype=object)
        read = VerifiedTask(paced, limits, costs[:3], costs[3])
        calls = _list_calls(task, read, sent + labels, k) if task.get("called") else {}
        works[task.get("network"), way, factor, form] = read._replace(calls=calls)
    return works, timed


def _list_works(task: Data, problem: Data) -> list[tuple[Any, ...]]:
    """Return the choices of a task by its own network that no other makes superfluous.

    They are the way of annotation, factor and worth of local steps, and name, share of the stored bits and loss of a
    form.
    """
    ways = list(task.get("annotations", ())) or [None]
    steps = [(each["factor"], each["worth"]) for each in task.get("local_steps", ())] or [(None, 1.0)]
    forms = [(None, Fraction(1), 0.0)]
    if task.get("forms"):
        forms = [
            (
                name,
                exact(BITS[name] * (form["fraction"] or 1) if form["bits"] is None else form["bits"]) / 32,
                form["loss"],
            )
            for name, form in task["forms"].items()
        ]
    limited = problem["horizon_s"] is not None and (task["train_s"] > 0 or any(task["vehicle_train_s"].values()))
    watched = problem.get("annotation_s") is not None
    every = [(way, *one, *other) for way, one, other in product(ways, steps, forms)]

    def replaces(one: Sequence[Any], other: Sequence[Any]) -> bool:
        """Return whether one choice takes no more time and bits than another, and teaches and loses no worse."""
        a, b = (task["annotations"][each[0]] if each[0] else CAREFUL for each in (one, other))
        annotated = (not watched or a["box_s"] <= b["box_s"]) and a["worth"] >= b["worth"] and a["loss"] <= b["loss"]
        quick = not limited or (one[1] or 1) <= (other[1] or 1)
        return annotated and quick and one[2] >= other[2] and one[4] <= other[4] and one[5] <= other[5]

    return [
        own
        for number, own in enumerate(every)
        if not any(replaces(each, own) for each in every[:number])
        and not any(replaces(each, own) and not replaces(own, each) for each in every[number + 1 :])
    ]


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


def _keep(task: VerifiedTask, budgets: list[int]) -> VerifiedTask:
    """Return the task with costs under the budgets that exist only."""
    calls = {number: _keep(called, budgets) for number, called in task.calls.items()}
    works = {names: _keep(work, budgets) for names, work in task.works.items()}
    return task._replace(unit=task.unit[:, budgets], once=task.once[budgets], calls=calls, works=works)


def list_branches(tasks: Sequence[VerifiedTask]) -> Iterator[tuple[VerifiedTask, ...]]:
    """Yield the tasks for every combination of rounds, and in it of vehicles called, and of limits on cloud rounds.

    Limits without and with cloud rounds are two branches where the first cloud round has a cost that is paid once.
    """
    for chosen in product(*(task.works.values() or (task,) for task in tasks)):
        yield from _list_parts(chosen)


def _list_parts(tasks: Sequence[VerifiedTask]) -> Iterator[tuple[VerifiedTask, ...]]:
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
        pace = curve.get("pace", 1.0)
        counted = (curve.get("worth", 1.0) * x, pace * y, pace * z)
        powers = ((curve[stage], each) for stage, each in zip(STAGES, counted))
        parts = [
            power["a"] * np.asarray(each + power["x0"], float) ** -power["b"]
            for power, each in powers
            if power["a"] > 0
        ]
        return curve["floor"] + curve["merge"] * (z > 0) + sum(parts)
    effective = curve.get("worth", 1.0) * curve["alpha"] * x + held_samples(curve, y, z, k)
    return curve["floor"] + compute_drift(curve, z) + curve["a"] * np.asarray(effective, float) ** -curve["b"]


def held_samples(curve: Data, y: Any, z: Any, k: int) -> Any:
    """Return the effective samples that edge rounds `y` and cloud rounds `z` bring, elementwise."""
    groups, left, pace = np.atleast_1d(curve["group_samples"]), curve.get("left", 0.0), curve.get("pace", 1.0)
    t, z = pace * (y + k * z), pace * z
    mean = fsum(groups) / len(groups)
    later = curve.get("gamma", 0.0) * mean * (len(groups) - 1) + left * curve.get("trained", False)
    return curve["beta"] * ((mean - left) * t / (t + 1) + later * z / (z + 1))


def compute_drift(curve: Data, z: Any) -> Any:
    """Return the change of the error by averaging over regions in `z` cloud rounds, elementwise."""
    drift = curve.get("drift", 0.0)
    return drift * z / (z + 1) if drift > 0 else -drift / (z + 1)
