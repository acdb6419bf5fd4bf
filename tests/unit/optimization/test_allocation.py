"""Allocation against exhaustive search and a convex solver that share no code with it."""

import copy
import itertools

import cvxpy as cp
import numpy as np
import pytest

from flcav.config import InputError, parse_config
from flcav.optimization.allocation import Infeasible, allocate
from flcav.optimization.problem import Problem
from flcav.optimization.separable import relax, separable

LIMITS = {"samples": [100, 5000], "edge_rounds": [0, 100], "cloud_rounds": [0, 100]}


def written(seed: int, tasks: int, model: str, limits: dict = LIMITS, budget: float = 1500.0, k: int = 1) -> dict:
    rng = np.random.default_rng(seed)
    draw = rng.uniform

    def curve() -> dict:
        if model == "additive":
            stages = ("pretrain", "edge", "cloud")
            return {"model": model, "floor": 0.02} | {
                s: {"a": draw(0.1, 1), "b": draw(0.2, 0.9), "x0": draw(0.5, 2)} for s in stages
            }
        group = int(draw(200, 3000))
        numbers = {"a": draw(0.5, 8), "b": draw(0.1, 0.7), "alpha": 0.1, "beta": 0.5, "group_samples": group}
        return {"model": model, "floor": 0.01, **numbers}

    def task(number: int) -> dict:
        sizes = {"sample_mb": draw(0.5, 2), "model_mb": draw(5, 60), "edge_groups": rng.integers(1, 5, 2).tolist()}
        return {"name": f"t{number}", "weight": draw(0.2, 1), **sizes, "limits": limits, "curve": curve()}

    budgets = {"wireless": budget * tasks, "wireline": budget * tasks * draw(0.2, 1)}
    return {"budgets_mb": budgets, "edge_rounds_per_cloud_round": k, "tasks": [task(i) for i in range(tasks)]}


def parsed(values: dict) -> Problem:
    return parse_config(Problem, values, "problem")


def searched(values: dict) -> float:
    """Return the least weighted error by trying every plan."""
    k = values["edge_rounds_per_cloud_round"]
    choices = []
    for task in values["tasks"]:
        c, limits = task["curve"], task["limits"]
        grids = np.meshgrid(*(np.arange(low, high + 1) for low, high in limits.values()), indexing="ij")
        x, y, z = (grid.ravel().astype(float) for grid in grids)
        if c["model"] == "additive":
            powers = ((c["pretrain"], x), (c["edge"], y), (c["cloud"], z))
            error = c["floor"] + sum(p["a"] * (v + p["x0"]) ** -p["b"] for p, v in powers)
        else:
            t = y + k * z
            n = c["alpha"] * x + c["beta"] * c["group_samples"] * (1 - 1 / (t + 1))
            error = c["floor"] + c["a"] * n ** -c["b"]
        vehicles, servers, model = sum(task["edge_groups"]), len(task["edge_groups"]), task["model_mb"]
        wireless = x * task["sample_mb"] + (y + k * z) * vehicles * model
        wireline = x * task["sample_mb"] + z * servers * model
        kept = z <= (1 if k == 0 else np.inf)
        choices.append([v[kept] for v in (task["weight"] * error, wireless, wireline)])
    budget = values["budgets_mb"]
    total = [np.zeros(1), np.zeros(1), np.zeros(1)]
    for choice in choices:
        total = [np.add.outer(t, v).ravel() for t, v in zip(total, choice)]
        fits = (total[1] <= budget["wireless"] + 1e-9) & (total[2] <= budget["wireline"] + 1e-9)
        total = [v[fits] for v in total]
    return float(total[0].min())


@pytest.mark.parametrize(("model", "seed", "k"), itertools.product(("additive", "effective"), range(4), (0, 1, 2)))
def test_one_task_is_solved_exactly(model, seed, k):
    limits = {"samples": [1, 600], "edge_rounds": [0, 12], "cloud_rounds": [0, 8]}
    values = written(seed, 1, model, limits, budget=900.0, k=k)
    plan = allocate(parsed(values))
    assert plan.objective == pytest.approx(searched(values), rel=1e-8)
    assert plan.gap <= 1e-8


@pytest.mark.parametrize(("model", "seed"), itertools.product(("additive", "effective"), range(4)))
def test_small_instances_are_within_their_gap_of_exhaustive_search(model, seed):
    limits = {"samples": [1, 12], "edge_rounds": [0, 4], "cloud_rounds": [0, 3]}
    values = written(seed, 3, model, limits, budget=350.0)
    best, plan = searched(values), allocate(parsed(values))
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert best - 1e-9 <= plan.objective <= best * (1 + plan.gap + 1e-9)
    assert plan.gap <= 1e-3


@pytest.mark.parametrize("tasks", [3, 30, 300])
@pytest.mark.parametrize("seed", [0, 1])
def test_random_instances_are_proven_within_a_thousandth_and_within_budget(tasks, seed):
    values = written(seed, tasks, "additive")
    plan = allocate(parsed(values))
    assert plan.gap <= 1e-3
    assert plan.used_mb.wireless_mb <= values["budgets_mb"]["wireless"] + 1e-6
    assert plan.used_mb.wireline_mb <= values["budgets_mb"]["wireline"] + 1e-6


@pytest.mark.parametrize("wireline", [0.1, 0.35, 5.0])
def test_the_relaxed_optimum_is_that_of_a_convex_solver(wireline):
    rng = np.random.default_rng(3)
    n = 60
    cost = np.zeros((n // 3, 3, 2))
    cost[:, 0] = rng.uniform(0.2, 2, (n // 3, 1))
    cost[:, 1, 0] = cost[:, 2, 0] = rng.uniform(1, 300, n // 3)
    cost[:, 2, 1] = rng.uniform(1, 200, n // 3)
    a, b, x0 = rng.uniform(0.1, 1, n), rng.uniform(0.2, 0.9, n), rng.uniform(0.5, 2, n)
    low, high = np.zeros(n), np.tile([5000.0, 100.0, 100.0], n // 3)
    budget = 1000.0 * n / 3 * np.array([1.0, wireline])
    ours = relax(separable(a, b, x0, low, high, cost.reshape(-1, 2), budget))
    x = cp.Variable(n)
    error = cp.sum(cp.multiply(a, cp.exp(cp.multiply(-b, cp.log(x + x0)))))
    theirs = cp.Problem(cp.Minimize(error), [cost.reshape(-1, 2).T @ x <= budget, x >= low, x <= high])
    theirs.solve(solver=cp.CLARABEL)
    assert ours.bound == pytest.approx(theirs.value, rel=1e-6)
    assert ours.multipliers == pytest.approx(np.asarray(theirs.constraints[0].dual_value), rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("model", ["additive", "effective"])
def test_doubling_budgets_that_bind_changes_the_plan_for_the_better(model):
    values = written(5, 2, model)
    doubled = copy.deepcopy(values)
    doubled["budgets_mb"] = {link: 2 * mb for link, mb in values["budgets_mb"].items()}
    before, after = allocate(parsed(values)), allocate(parsed(doubled))
    assert after.tasks != before.tasks
    assert after.objective < before.objective
    assert before.marginal_error_per_gb.wireless_mb > 0


def test_budgets_that_do_not_bind_are_worth_nothing_and_the_plan_stands_at_its_limits():
    limits = {"samples": [1, 10], "edge_rounds": [0, 2], "cloud_rounds": [0, 2]}
    plan = allocate(parsed(written(0, 2, "additive", limits, budget=1e5)))
    assert [(t.samples, t.edge_rounds, t.cloud_rounds) for t in plan.tasks] == [(10, 2, 2)] * 2
    assert (plan.marginal_error_per_gb.wireless_mb, plan.marginal_error_per_gb.wireline_mb) == (0.0, 0.0)


def test_an_infinite_error_at_zero_is_never_chosen():
    values = written(0, 1, "additive")
    values["tasks"][0]["curve"]["edge"]["x0"] = 0
    assert allocate(parsed(values)).tasks[0].edge_rounds >= 1


def test_infeasible_names_the_budget_the_least_and_the_difference():
    values = written(0, 1, "additive")
    values["tasks"][0]["sample_mb"] = 2.0
    values["budgets_mb"] = {"wireless": 1000, "wireline": 150}
    with pytest.raises(Infeasible, match=r"200 MB of wireline uplink, 50 MB more than budgets_mb.wireline = 150"):
        allocate(parsed(values))


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("budgets_mb", "wireless"), 0, "budgets_mb.wireless"),
        (("budgets_mb", "wireline"), float("nan"), "budgets_mb.wireline"),
        (("tasks", 0, "sample_mb"), -1.0, "sample_mb"),
        (("tasks", 0, "model_mb"), float("inf"), "model_mb"),
        (("tasks", 0, "edge_groups"), [], "edge_groups"),
        (("tasks", 0, "curve", "edge", "b"), 0, "edge.b"),
        (("tasks", 0, "limits", "samples"), [5, 4], "samples"),
        (("tasks", 0, "limits", "samples"), [], "samples"),
        (("tasks", 0, "colour"), "red", "colour"),
        (("tasks", 0, "curve", "model"), "magic", "curve"),
        (("tasks",), [], "tasks"),
    ],
)
def test_bad_input_is_one_sentence_naming_the_field(path, value, named):
    values = copy.deepcopy(written(0, 1, "additive"))
    *parents, last = path
    place = values
    for part in parents:
        place = place[part]
    place[last] = value
    with pytest.raises(InputError, match=named):
        parsed(values)
