from itertools import product
from typing import Any

import numpy as np
import pytest

from flcav.config import parse_config
from flcav.optimization.allocation.allocate import TaskAllocation, allocate
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.vehicles import split_plan
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Infeasible, price_counts


def problem(tasks: list[dict[str, Any]], **values: Any) -> Problem:
    filled = [
        {
            "name": f"task{number}",
            "sample_mb": 2.0,
            "model_mb": 5.0,
            "edge_groups": [2, 1],
            "limits": {"samples": [1, 7], "edge_rounds": [0, 3], "cloud_rounds": [0, 2]},
            "curve": {
                "model": "additive",
                "floor": 0.05,
                "pretrain": {"a": 0.9, "b": 0.5},
                "edge": {"a": 0.3, "b": 0.6, "x0": 1},
                "cloud": {"a": 0.2, "b": 0.6, "x0": 1},
            },
            **task,
        }
        for number, task in enumerate(tasks)
    ]
    return parse_config(Problem, {"budgets_mb": {"wireless": 90, "wireline": 60}, "tasks": filled} | values, "test")


def fleet(*mbps: float) -> dict[str, dict[str, float]]:
    return {f"cav{number}": {"wireless": each} for number, each in enumerate(mbps)}


def best_carried(asked: Problem) -> float:
    """Return the least error of all plans that the budgets and the links carry, by trying every one."""
    (task,) = asked.tasks
    errors = []
    limits = (task.limits.samples, task.limits.edge_rounds, task.limits.cloud_rounds)
    for samples, edge_rounds, cloud_rounds in product(*(range(low, high + 1) for low, high in limits)):
        cost = price_counts(asked, task, (samples, edge_rounds, cloud_rounds))
        if cost.wireless_mb > asked.budgets_mb.wireless or cost.wireline_mb > asked.budgets_mb.wireline:
            continue
        error = float(task.curve.error(samples, edge_rounds, cloud_rounds, asked.edge_rounds_per_cloud_round))
        try:
            split_plan(asked, [TaskAllocation(task.name, samples, edge_rounds, cloud_rounds, error, 0.0, 0.0)])
        except Infeasible:
            continue
        errors.append(error)
    return min(errors)


def busiest_s(asked: Problem, shares: Any) -> float:
    busy: dict[str, float] = {}
    for task in asked.tasks:
        for share in shares[task.name]:
            sent = 8 * share.wireless_mb / (task.uplink_mbps or {})[share.vehicle].wireless
            busy[share.vehicle] = busy.get(share.vehicle, 0.0) + sent
    return max(busy.values())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_near_the_best_of_all_plans_that_can_be_carried(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mbps = rng.uniform(1, 10, 3)
    asked = problem([{"uplink_mbps": fleet(*mbps)}], horizon_s=float(rng.uniform(6, 25)))
    try:
        plan, shares = allocate_fleet(asked)
    except Infeasible:
        with pytest.raises(ValueError, match="empty"):
            best_carried(asked)
        return
    best = best_carried(asked)
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)
    assert best * (1 - 1e-9) <= plan.objective <= best * 1.05
    assert busiest_s(asked, shares) <= (asked.horizon_s or 0) * (1 + 1e-9)


def test_links_that_suffice_change_nothing() -> None:
    asked = problem([{"uplink_mbps": fleet(1000, 1000, 1000)}], horizon_s=30)
    assert allocate_fleet(asked)[0] == allocate(asked)


def test_slow_links_limit_the_plan_and_it_says_so() -> None:
    asked = problem([{"uplink_mbps": fleet(2, 2, 2)}, {"uplink_mbps": fleet(2, 2, 2)}], horizon_s=30)
    free = allocate(asked)
    plan, shares = allocate_fleet(asked)
    assert plan.objective > free.objective
    assert "own links" in (plan.note or "")
    assert plan.marginal_error_per_gb.wireless_mb == 0
    assert plan.gap == pytest.approx(plan.objective / (plan.lower_bound or 0) - 1)
    assert plan.used_mb.wireless_mb <= 90
    assert busiest_s(asked, shares) <= 30 * (1 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["max-min", "area"])
def test_other_objectives_are_carried_too(objective: str) -> None:
    tasks = [{"uplink_mbps": fleet(2, 2, 2)} for _ in range(3)]
    asked = problem(tasks, horizon_s=60, objective=objective)
    plan, shares = allocate_fleet(asked)
    assert busiest_s(asked, shares) <= 60 * (1 + 1e-9)
    assert (plan.lower_bound is None) == (objective == "area")


def test_no_more_samples_are_planned_than_vehicles_hold() -> None:
    asked = problem([{"uplink_mbps": fleet(9, 9, 9), "samples_held": {"cav0": 3, "cav1": 1, "cav2": 2}}])
    assert allocate(asked).tasks[0].samples > 6
    plan, shares = allocate_fleet(asked)
    assert plan.tasks[0].samples == sum(share.samples for share in shares["task0"]) == 6


def test_infeasible_says_what_is_missing() -> None:
    none_held = dict.fromkeys(("cav0", "cav1", "cav2"), 0)
    with pytest.raises(Infeasible, match=r"hold 0 samples .* limits.samples starts at 1"):
        allocate_fleet(problem([{"uplink_mbps": fleet(9, 9, 9), "samples_held": none_held}]))
    with pytest.raises(Infeasible, match=r"more than horizon_s = 1$"):
        allocate_fleet(problem([{"uplink_mbps": fleet(1, 1, 1)}], horizon_s=1))
