"""Allocation against exhaustive search and a convex solver that share no code with it."""

import copy
import itertools
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from made_problems import SMALL, parsed, searched, written

from flcav.config import InputError
from flcav.optimization.allocation.allocate import Allocation, allocate, weighted_error
from flcav.optimization.allocation.baselines import baseline
from flcav.optimization.allocation.replanning import PlanState, condition_problem
from flcav.optimization.solvers.instance import Infeasible, build_instance
from flcav.optimization.solvers.separable import ContinuousOptimum, Separable, solve_two_budgets

MODELS = ("additive", "effective", "federated")


@pytest.mark.parametrize(("model", "seed", "k"), [*itertools.product(MODELS, range(4), (0, 1, 2))])
def test_one_task_is_solved_exactly(model, seed, k):
    limits = {"samples": [1, 600], "edge_rounds": [0, 12], "cloud_rounds": [0, 8]}
    values = written(seed, 1, model, limits, budget=900.0, k=k)
    plan = allocate(parsed(values))
    assert plan.objective == pytest.approx(searched(values), rel=1e-8)
    assert plan.gap == pytest.approx(0, abs=1e-8)


@pytest.mark.parametrize(
    ("model", "seed", "objective"),
    [*itertools.product((*MODELS, "shared"), range(3), ("weighted", "max-min"))],
)
def test_small_instances_equal_exhaustive_search(model, seed, objective):
    values = written(seed, 3, model, SMALL, budget=300.0) | {"objective": objective}
    best, plan = searched(values), allocate(parsed(values))
    assert plan.objective == pytest.approx(best, rel=1e-9)
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert plan.gap == pytest.approx(0, abs=2e-9)


@pytest.mark.parametrize("tasks", [3, 10, 30, 100, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("model", "seed"), [("additive", 0), ("additive", 1), ("effective", 0), ("federated", 0), ("shared", 0)]
)
def test_random_instances_are_proven_within_a_thousandth_and_within_budget(tasks, model, seed):
    values = written(seed, tasks, model)
    plan = allocate(parsed(values))
    assert plan.gap is not None
    assert plan.gap <= 1e-3
    assert_within(values, plan)


@pytest.mark.parametrize(("tasks", "model"), [(10, "additive"), (30, "effective"), (10, "federated"), (30, "shared")])
def test_the_largest_error_is_proven_within_a_thousandth_and_within_budget(tasks, model):
    values = written(tasks, tasks, model) | {"objective": "max-min"}
    plan = allocate(parsed(values))
    errors = [each.predicted_error for task in plan.tasks for each in (task.members or (task,))]
    assert plan.objective == pytest.approx(max(errors), rel=1e-12)
    assert plan.gap is not None
    assert plan.gap <= 1e-3
    assert_within(values, plan)


def test_max_min_is_fairer_than_the_weighted_error_and_costs_some_of_it():
    values = written(4, 4, "additive")
    weighted, fair = allocate(parsed(values)), allocate(parsed(values | {"objective": "max-min"}))
    assert fair.objective < max(task.predicted_error for task in weighted.tasks)
    assert weighted_error(parsed(values), fair.tasks) >= weighted.objective


@pytest.mark.parametrize("wireline", [0.1, 0.35, 5.0])
def test_the_relaxed_optimum_is_that_of_a_convex_solver(wireline):
    ours, theirs, multipliers = both_solvers(wireline, members=1)
    assert ours.bound == pytest.approx(theirs, rel=1e-6)
    assert ours.multipliers == pytest.approx(multipliers, rel=1e-3, abs=1e-9)


def test_several_powers_of_one_quantity_have_the_optimum_of_a_convex_solver():
    ours, theirs, multipliers = both_solvers(0.35, members=3)
    assert ours.bound == pytest.approx(theirs, rel=1e-6)
    assert ours.multipliers == pytest.approx(multipliers, rel=1e-3, abs=1e-9)


def both_solvers(wireline: float, members: int) -> tuple[ContinuousOptimum, float, np.ndarray]:
    """Return our optimum, that of Clarabel, and its multipliers, with `members` powers of every quantity."""
    rng = np.random.default_rng(3)
    n = 60
    cost = np.zeros((n // 3, 3, 2))
    cost[:, 0] = rng.uniform(0.2, 2, (n // 3, 1))
    cost[:, 1, 0] = cost[:, 2, 0] = rng.uniform(1, 300, n // 3)
    cost[:, 2, 1] = rng.uniform(1, 200, n // 3)
    m = members * n
    a, b, x0 = rng.uniform(0.1, 1, m), rng.uniform(0.2, 0.9, m), rng.uniform(0.5, 2, m)
    of = np.repeat(np.arange(n), members)
    low, high = np.zeros(n), np.tile([5000.0, 100.0, 100.0], n // 3)
    budget = 1000.0 * n / 3 * np.array([1.0, wireline])
    ours = solve_two_budgets(Separable(a, b, x0, low, high, cost.reshape(-1, 2), budget, of if members > 1 else None))
    x = cp.Variable(n)
    error = cp.sum(cp.multiply(a, cp.exp(cp.multiply(-b, cp.log(x[of] + x0)))))
    theirs = cp.Problem(cp.Minimize(error), [cost.reshape(-1, 2).T @ x <= budget, x >= low, x <= high])
    theirs.solve(solver=cp.CLARABEL)
    return ours, float(theirs.value), np.asarray(theirs.constraints[0].dual_value)  # pyright: ignore[reportArgumentType]


def test_marginal_values_are_the_slope_of_the_relaxed_optimum():
    values = written(2, 30, "additive", budget=700.0)
    values["budgets_mb"]["wireline"] = 0.25 * values["budgets_mb"]["wireless"]
    powers, plan = build_instance(parsed(values)).separable, allocate(parsed(values))
    rates = (plan.marginal_error_per_gb.wireless_mb, plan.marginal_error_per_gb.wireline_mb)
    for link, rate in enumerate(rates):
        step = 1e-3 * powers.budget[link] * np.eye(2)[link]
        less, more = (solve_two_budgets(replace(powers, budget=powers.budget + sign * step)).bound for sign in (-1, 1))
        assert rate > 0
        assert rate == pytest.approx(1000 * (less - more) / (2 * step[link]), rel=0.02)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    tasks=st.integers(1, 5),
    model=st.sampled_from((*MODELS, "shared")),
    budget=st.floats(200, 4000),
    k=st.integers(0, 2),
)
@example(seed=17, tasks=1, model="federated", budget=842.0, k=0)  # the most samples are best at each pair of rounds
def test_plans_are_within_budgets_and_limits_and_more_budget_is_never_worse(seed, tasks, model, budget, k):
    limits = {"samples": [1, 900], "edge_rounds": [0, 12], "cloud_rounds": [0, 8]}
    values = written(seed, tasks, model, limits, budget, k)
    plan = allocate(parsed(values))
    assert_within(values, plan)
    assert plan.lower_bound is not None
    more = allocate(parsed(values | {"budgets_mb": {link: 1.3 * mb for link, mb in values["budgets_mb"].items()}}))
    assert more.lower_bound is not None
    assert more.lower_bound <= plan.objective * (1 + 1e-9)
    assert more.objective <= plan.objective * (1 + 1e-4)


def assert_within(values: dict, plan: Allocation) -> None:
    """Check the plan against budgets and limits by arithmetic of its own."""
    k = values["edge_rounds_per_cloud_round"]
    spent = np.zeros(2)
    for task, got in zip(values["tasks"], plan.tasks, strict=True):
        for name, (low, high) in task["limits"].items():
            assert low <= getattr(got, name) <= high
        vehicles, servers, model = sum(task["edge_groups"]), len(task["edge_groups"]), task["model_mb"]
        uploaded = got.samples * task["sample_mb"]
        spent += uploaded + model * np.array(
            [(got.edge_rounds + k * got.cloud_rounds) * vehicles, got.cloud_rounds * servers]
        )
        assert k > 0 or got.cloud_rounds <= 1
    assert spent == pytest.approx((plan.used_mb.wireless_mb, plan.used_mb.wireline_mb), rel=1e-9)
    assert np.all(spent <= np.array([*values["budgets_mb"].values()]) * (1 + 1e-11))


def test_exchanges_and_labels_have_prices_of_their_own():
    limits = {"samples": [20, 60], "edge_rounds": [0, 6], "cloud_rounds": [1, 5]}
    values: dict[str, Any] = written(5, 1, "additive", limits)
    values["budgets_mb"] = {"wireless": 150.0, "wireline": 150.0}
    task, k = values["tasks"][0], values["edge_rounds_per_cloud_round"]
    task |= {"model_mb": 12.0, "exchange_mb": 3.0, "labels_mb": 2.0}
    vehicles, servers = sum(task["edge_groups"]), len(task["edge_groups"])
    problem, best = parsed(values), (np.inf, 0, 0, 0, 0.0, 0.0)
    for counts in itertools.product(range(20, 61), range(7), range(1, 6)):
        samples, edge, cloud = counts
        wireless = samples * task["sample_mb"] + vehicles * ((edge + k * cloud) * 3.0 + (edge + 1) * 2.0)
        wireline = samples * task["sample_mb"] + servers * cloud * 12.0
        if wireless <= 150.0 and wireline <= 150.0:
            best = min(best, (float(problem.tasks[0].curve.error(*counts, k)), *counts, wireless, wireline))
    plan = allocate(problem)
    (own,) = plan.tasks
    assert (own.samples, own.edge_rounds, own.cloud_rounds) == best[1:4]
    assert (own.wireless_mb, own.wireline_mb) == pytest.approx(best[4:])
    assert baseline(problem, "equal-stages").used_mb.wireless_mb <= 150.0
    done = {"samples": own.samples, "edge_rounds": own.edge_rounds, "cloud_rounds": 1}
    state = PlanState.model_validate({"tasks": {own.name: done}})
    assert allocate(condition_problem(problem, state)).tasks[0].cloud_rounds == best[3]


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
        (("budgets_mb", "wireless"), -5, "budgets_mb.wireless' = -5"),
        (("budgets_mb", "wireline"), None, "budgets_mb.wireline"),
        (("edge_rounds_per_cloud_round",), -1, "edge_rounds_per_cloud_round' = -1"),
        (("objective",), "cheapest", "objective' = 'cheapest'"),
        (("objective",), "area", "at least 3 tasks"),
        (("robust",), True, "'upper'"),
        (("performance",), 0.8, "performance_without"),
        (("tasks", 0, "weight"), float("nan"), "weight' = nan"),
        (("tasks", 0, "sample_mb"), float("nan"), "sample_mb' = nan"),
        (("tasks", 0, "model_mb"), 0, "model_mb' = 0"),
        (("tasks", 0, "edge_groups"), [4, 0], "edge_groups"),
        (("tasks", 0, "curve", "pretrain", "a"), -1, "pretrain.a' = -1"),
        (("tasks", 0, "curve", "pretrain", "a"), float("nan"), "pretrain.a' = nan"),
        (("tasks", 0, "curve", "cloud", "x0"), -0.5, "cloud.x0' = -0.5"),
        (("tasks", 0, "curve", "floor"), -0.1, "floor' = -0.1"),
        (("tasks", 0, "curve", "power"), 2, "unknown field 'tasks.0.curve.additive.power'"),
        (("tasks", 0, "limits", "cloud_rounds"), [-1, 4], "cloud_rounds"),
        (("tasks", 0, "limits", "edge_rounds"), [0.5, 4], "edge_rounds"),
        (("tasks", 0, "measured"), {"sample": 3}, "measured.sample'"),
    ],
)
def test_bad_input_is_one_sentence_naming_the_field(path, value, named):
    values = copy.deepcopy(written(0, 1, "additive"))
    *parents, last = path
    place = values
    for part in parents:
        place = place[part]
    place[last] = value
    with pytest.raises(InputError) as refused:
        parsed(values)
    assert named in str(refused.value)
    assert "\n" not in str(refused.value)
