"""Random allocation problems, and what trying every plan finds."""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import parse_config
from flcav.optimization.problem import Problem

LIMITS = {"samples": [100, 5000], "edge_rounds": [0, 100], "cloud_rounds": [0, 100]}
SMALL = {"samples": [1, 8], "edge_rounds": [0, 4], "cloud_rounds": [0, 3]}
STAGES = ("pretrain", "edge", "cloud")


def written(seed: int, tasks: int, model: str, limits: dict = LIMITS, budget: float = 1500.0, k: int = 1) -> dict:
    """Return a problem as a user writes it; budgets are per task, and both may bind."""
    rng = np.random.default_rng(seed)
    draw = rng.uniform

    def curve() -> dict[str, Any]:
        if model == "additive":
            return {"model": model, "floor": 0.02} | {
                s: {"a": draw(0.1, 1), "b": draw(0.2, 0.9), "x0": draw(0.5, 2)} for s in STAGES
            }
        if model == "shared":
            own = {s: {"a": draw(0.1, 0.4), "b": draw(0.2, 0.9), "x0": draw(0.5, 2)} for s in STAGES}
            other = {s: {"a": draw(0.1, 0.4), "b": draw(0.2, 0.9), "x0": draw(0.5, 2)} for s in STAGES}
            name = f"{draw()}"
            members = [
                {"name": name + each, "weight": draw(0.5, 2), "curve": {"model": "additive", **decays}}
                for each, decays in (("a", own), ("b", other))
            ]
            return {"model": "shared", "members": members}
        if model == "federated":
            numbers = {"a": draw(0.5, 8), "b": draw(0.1, 0.7), "alpha": 0.1, "beta": 0.5, "gamma": draw(0, 1.5)}
            regions = rng.integers(100, 1500, 2).tolist()
            return {"model": model, "floor": 0.01, **numbers, "group_samples": regions, "drift": draw(-0.2, 0.2)}
        group = int(draw(200, 3000))
        numbers = {"a": draw(0.5, 8), "b": draw(0.1, 0.7), "alpha": 0.1, "beta": 0.5, "group_samples": group}
        return {"model": model, "floor": 0.01, **numbers}

    def task(number: int) -> dict[str, Any]:
        sizes = {"sample_mb": draw(0.5, 2), "model_mb": draw(5, 60), "edge_groups": rng.integers(1, 5, 2).tolist()}
        return {"name": f"t{number}", "weight": draw(0.2, 1), **sizes, "limits": limits, "curve": curve()}

    budgets = {"wireless": budget * tasks, "wireline": budget * tasks * draw(0.2, 1)}
    return {"budgets_mb": budgets, "edge_rounds_per_cloud_round": k, "tasks": [task(i) for i in range(tasks)]}


def parsed(values: dict) -> Problem:
    """Return the checked problem."""
    return parse_config(Problem, values, "problem")


def _error(curve: dict, x: NDArray, y: NDArray, z: NDArray, k: int) -> list[tuple[float, NDArray]]:
    """Return the weight and error of everything that is learned."""
    if curve["model"] == "shared":
        total = sum(member["weight"] for member in curve["members"])
        return [(m["weight"] / total, _error(m["curve"], x, y, z, k)[0][1]) for m in curve["members"]]
    if curve["model"] == "additive":
        powers = ((curve["pretrain"], x), (curve["edge"], y), (curve["cloud"], z))
        error = curve.get("floor", 0) + sum(p["a"] * (v + p["x0"]) ** -p["b"] for p, v in powers)
        return [(1.0, error + np.where(z > 0, curve.get("merge", 0), 0))]
    if curve["model"] == "federated":
        groups, drift = curve["group_samples"], curve["drift"]
        own = sum(groups) / len(groups)
        known = own * (1 - 1 / (y + k * z + 1)) + curve["gamma"] * (sum(groups) - own) * z / (z + 1)
        power = curve["a"] * (curve["alpha"] * x + curve["beta"] * known) ** -curve["b"]
        return [(1.0, curve["floor"] + power + (drift * z / (z + 1) if drift > 0 else -drift / (z + 1)))]
    n = curve["alpha"] * x + curve["beta"] * curve["group_samples"] * (1 - 1 / (y + k * z + 1))
    return [(1.0, curve["floor"] + curve["a"] * n ** -curve["b"])]


def searched(values: dict) -> float:
    """Return the best objective by trying every plan: the least weighted error, or the least largest one.

    Plans include each number of local steps and each form of updates that a task leaves to choose.
    """
    k, largest = values["edge_rounds_per_cloud_round"], values.get("objective") == "max-min"
    choices = []
    for task in values["tasks"]:
        grids = np.meshgrid(*(np.arange(low, high + 1) for low, high in task["limits"].values()), indexing="ij")
        x, y, z = (grid.ravel().astype(float) for grid in grids)
        own = []
        for steps, (name, form) in product(
            task.get("local_steps") or [{"factor": 1}], (task.get("forms") or {"float32": {}}).items()
        ):
            worth, drift = steps.get("worth", 1.0), task["curve"].get("drift", 0.0)
            loss = form.get("loss", 0.0) + drift * (z / (z + 1) - worth * z / (worth * z + 1))  # a drift has no pace
            errors = [(w, e + loss) for w, e in _error(task["curve"], x, worth * y, worth * z, k)]
            error = (
                np.max([e for _, e in errors], axis=0) if largest else task["weight"] * sum(w * e for w, e in errors)
            )
            bits = {"float32": 32, "fp16": 16, "int8": 8, "int4": 4, "top-k": 64}[name] * form.get("fraction", 1)
            model = task["model_mb"] * form.get("bits", bits) / 32
            vehicles, servers = sum(task["edge_groups"]), len(task["edge_groups"])
            exchange, labels = task.get("exchange_mb", model), task.get("labels_mb", 0.0)
            wireless = x * task["sample_mb"] + vehicles * ((y + k * z) * exchange + (y + (z > 0)) * labels)
            wireline = x * task["sample_mb"] + z * servers * model
            kept = z <= (1 if k == 0 else np.inf)
            busy_s = (y + k * z) * task.get("train_s", 0.0) * steps["factor"]
            own.append([v[kept] for v in (error, wireless, wireline, busy_s)])
        choices.append([np.concatenate(parts) for parts in zip(*own, strict=True)])
    budget, horizon_s = values["budgets_mb"], values.get("horizon_s", np.inf)
    total = [np.zeros(1)] * 4
    for choice in choices:
        merge = np.maximum if largest else np.add
        total = [f.outer(t, v).ravel() for f, t, v in zip((merge, *[np.add] * 3), total, choice)]
        fits = total[3] <= horizon_s + 1e-9
        fits &= (total[1] <= budget["wireless"] + 1e-9) & (total[2] <= budget["wireline"] + 1e-9)
        total = [v[fits] for v in total]
    return float(total[0].min())
