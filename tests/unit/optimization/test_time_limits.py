"""Plans within the time in which vehicles train and send, against trying every plan."""

import contextlib
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_problems import SMALL, parsed, searched, written
from test_fleet import best_carried, fleet, problem

from flcav.optimization.allocation.allocate import TaskAllocation, allocate
from flcav.optimization.allocation.baselines import BASELINES, baseline
from flcav.optimization.allocation.budget_sweep import compute_savings
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.replanning import PlanState, condition_problem
from flcav.optimization.allocation.vehicles import split_plan
from flcav.optimization.solvers.fairness import find_undominated
from flcav.optimization.solvers.instance import Infeasible


def timed(seed: int, tasks: int, model: str, horizon_s: float, **more: Any) -> dict[str, Any]:
    """Return a random problem whose vehicles have no names and train some seconds in every round."""
    values: dict[str, Any] = written(seed, tasks, model, more.pop("limits", SMALL), **more)
    rng = np.random.default_rng(seed)
    for task in values["tasks"]:
        task["train_s"] = float(rng.uniform(1, 10))
    return values | {"horizon_s": horizon_s}


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    tasks=st.integers(1, 3),
    model=st.sampled_from(("additive", "effective", "federated", "shared")),
    objective=st.sampled_from(("weighted", "max-min")),
    horizon_s=st.floats(0.5, 80),
    k=st.integers(0, 2),
)
def test_plans_of_vehicles_without_names_are_the_best_of_all(
    seed: int, tasks: int, model: str, objective: str, horizon_s: float, k: int
) -> None:
    values: dict[str, Any] = timed(seed, tasks, model, horizon_s, budget=300.0, k=k) | {"objective": objective}
    best, plan = searched(values), allocate(parsed(values))
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert plan.objective == pytest.approx(best, rel=1e-8)
    rounds = [got.edge_rounds + k * got.cloud_rounds for got in plan.tasks]
    busy_s = sum(count * task["train_s"] for count, task in zip(rounds, values["tasks"]))
    assert plan.busy_s == pytest.approx(busy_s)
    assert busy_s <= horizon_s * (1 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "objective"), [*itertools.product(("additive", "effective"), ("weighted", "max-min"))]
)
def test_many_tasks_are_proven_within_a_thousandth(model: str, objective: str) -> None:
    limits = {"samples": [100, 3000], "edge_rounds": [0, 40], "cloud_rounds": [0, 20]}
    values = timed(3, 12, model, 250.0, limits=limits) | {"objective": objective}
    plan = allocate(parsed(values))
    assert plan.gap is not None
    assert plan.gap <= 1e-3
    assert plan.objective > allocate(parsed(values | {"horizon_s": None})).objective


def test_a_horizon_makes_caps_by_hand_needless() -> None:
    limits = {"samples": [1, 600], "edge_rounds": [0, 60], "cloud_rounds": [0, 0]}
    values = written(1, 1, "effective", limits, 9000.0)
    values["tasks"][0]["train_s"] = 7.0
    capped = written(1, 1, "effective", limits | {"edge_rounds": [0, 6]}, 9000.0)
    plan = allocate(parsed(values | {"horizon_s": 45.0}))
    assert plan.tasks == allocate(parsed(capped)).tasks
    assert plan.tasks[0].edge_rounds == 6
    assert plan.busy_s == 42.0


@pytest.mark.slow
@pytest.mark.parametrize("name", BASELINES)
def test_baselines_keep_the_time_too(name: str) -> None:
    limits = {"samples": [20, 900], "edge_rounds": [0, 12], "cloud_rounds": [0, 8]}
    values = timed(2, 3, "additive", 60.0, limits=limits)
    compared, plan = baseline(parsed(values), name), allocate(parsed(values))
    busy_s = sum(
        (got.edge_rounds + got.cloud_rounds) * task["train_s"] for got, task in zip(compared.tasks, values["tasks"])
    )
    assert busy_s <= 60.0 * (1 + 1e-9)
    assert compared.objective >= (plan.lower_bound or 0) * (1 - 1e-9)


def test_area_savings_and_replanning_keep_the_time() -> None:
    values = timed(4, 3, "additive", 30.0, budget=300.0)
    area = allocate(parsed(values | {"objective": "area"}))
    assert 0 < (area.busy_s or 0) <= 30.0
    for each in compute_savings(parsed(values), allocate(parsed(values))):
        budgets = values["budgets_mb"]
        more = searched(values | {"budgets_mb": budgets | {each.link: budgets[each.link] * (1 + each.added)}})
        assert each.objective == pytest.approx(more, rel=1e-8)
    state = PlanState.model_validate({"tasks": {"t0": {"samples": 2, "edge_rounds": 1}}})
    left = allocate(condition_problem(parsed(values), state))
    assert (left.tasks[0].samples, left.tasks[0].edge_rounds >= 1) == (2, True)
    assert (left.busy_s or 0) <= 30.0


def test_rounds_that_the_limits_ask_for_and_time_forbids_are_refused_in_a_sentence() -> None:
    values = timed(0, 1, "additive", 10.0, limits=SMALL | {"edge_rounds": [4, 4]}, budget=5000.0)
    values["tasks"][0]["train_s"] = 3.0
    with pytest.raises(Infeasible, match=r"takes 12 s on a vehicle, 2 s more than horizon_s = 10$"):
        allocate(parsed(values))


@pytest.mark.slow
@pytest.mark.parametrize("linked", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_named_vehicles_come_near_the_best_of_all_plans(seed: int, linked: bool) -> None:
    rng = np.random.default_rng(seed)
    slow = {f"cav{i}": float(rng.uniform(2, 12)) for i in range(3)}
    task: dict[str, Any] = {"vehicle_train_s": slow} | (
        {"uplink_mbps": fleet(*rng.uniform(3, 12, 3))} if linked else {}
    )
    asked = problem([task], horizon_s=float(rng.uniform(15, 30)))
    plan, shares = allocate_fleet(asked)
    best = best_carried(asked)
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert best * (1 - 1e-9) <= plan.objective <= best * 1.05
    busy_s = {
        share.vehicle: slow[share.vehicle] * len(share.rounds)
        + (8 * share.wireless_mb / task["uplink_mbps"][share.vehicle]["wireless"] if linked else 0.0)
        for share in shares["task0"]
    }
    assert plan.busy_s == pytest.approx(max(busy_s.values()))
    assert max(busy_s.values()) <= (asked.horizon_s or 0) * (1 + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_bounds_hold_for_fleets_that_train_one_task_fast_and_another_slowly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = {"samples": [1, 2], "edge_rounds": [0, 3], "cloud_rounds": [0, 0]}
    slow = [{f"cav{i}": float(rng.choice([1.0, 12.0])) for i in range(3)} for _ in range(2)]
    asked = problem(
        [{"vehicle_train_s": each, "limits": limits} for each in slow], horizon_s=float(rng.uniform(12, 30))
    )
    plan, _ = allocate_fleet(asked)
    errors = []
    for counts in itertools.product(itertools.product((1, 2), range(4)), repeat=2):
        errors_of = [float(task.curve.error(*own, 0)) for task, own in zip(asked.tasks, counts)]
        plans = [TaskAllocation(task.name, *own, 0, 0.0, 0.0, 0.0) for task, own in zip(asked.tasks, counts)]
        with contextlib.suppress(Infeasible):
            split_plan(asked, plans)
            errors.append(sum(errors_of))
    assert plan.lower_bound is not None
    assert plan.lower_bound <= min(errors) * (1 + 1e-9)
    assert min(errors) * (1 - 1e-9) <= plan.objective <= min(errors) * 1.1


def test_training_time_that_limits_a_named_fleet_is_said() -> None:
    slow = {f"cav{i}": 20.0 for i in range(3)}
    asked = problem([{"vehicle_train_s": slow}], horizon_s=45.0)
    plan, _ = allocate_fleet(asked)
    assert "time to send and to train" in (plan.note or "")
    limits = {"samples": [1, 7], "edge_rounds": [2, 3], "cloud_rounds": [0, 2]}
    with pytest.raises(Infeasible, match=r"the vehicles need .* more than horizon_s = 1$"):
        allocate_fleet(problem([{"vehicle_train_s": slow, "limits": limits}], horizon_s=1.0))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), columns=st.integers(2, 4))
def test_the_pareto_front_is_what_no_other_row_dominates(seed: int, columns: int) -> None:
    cost = np.random.default_rng(seed).integers(0, 5, (30, columns)).astype(float)
    found = find_undominated(cost)
    rows = {tuple(row) for row in cost.tolist()}
    front = {row for row in rows if not any(o != row and all(a <= b for a, b in zip(o, row)) for o in rows)}
    assert sorted(map(tuple, cost[found].tolist())) == sorted(front)


def test_a_horizon_in_which_nothing_takes_time_is_told() -> None:
    values: dict[str, Any] = written(1, 1, "additive", SMALL, 300.0) | {"horizon_s": 10.0}
    (warning,) = allocate(parsed(values)).warnings
    assert warning == "horizon_s = 10 limits nothing: no task has train_s, vehicle_train_s or uplink_mbps"
    values["tasks"][0]["train_s"] = 1.0
    assert allocate(parsed(values)).warnings == ()


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_take_a_task_that_needs_no_time_beside_one_that_does(name: str) -> None:
    values = timed(2, 2, "additive", 40.0, budget=300.0)
    del values["tasks"][1]["train_s"]
    plan = baseline(parsed(values), name)
    assert plan.tasks[0].edge_rounds * values["tasks"][0]["train_s"] <= 40.0 * (1 + 1e-9)
    assert plan.objective >= allocate(parsed(values)).objective * (1 - 1e-9)
