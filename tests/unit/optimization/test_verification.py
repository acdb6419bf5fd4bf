"""The verifier: its bounds hold for any dual, and it refuses plans and placements that were tampered with."""

import json
from collections.abc import Callable
from dataclasses import asdict
from itertools import product
from typing import Any

import numpy as np
import pytest
from made_problems import SMALL, parsed, searched, written

from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.placement.cheapest import cover_share
from flcav.optimization.placement.solve import find_candidates, place_budget
from flcav.optimization.verification.allocation import bound_largest, bound_weighted, verify_allocation
from flcav.optimization.verification.placement import PlacementProblem, verify_placement
from flcav.optimization.verification.record import Verification, exact
from flcav.optimization.verification.tasks import least_cost, list_branches, read_tasks

MODELS = ("additive", "effective", "federated", "shared")
Data = dict[str, Any]


def costly(seed: int, tasks: int, model: str, **more: Any) -> Data:
    """Return a problem whose first cloud rounds cost labels, and accuracy where the curve knows that."""
    values: Data = written(seed, tasks, model, SMALL, 300.0, k=1 + seed % 2) | more
    rng = np.random.default_rng(seed)
    for task in values["tasks"]:
        task |= {"labels_mb": float(rng.uniform(0.5, 8)), "exchange_mb": float(rng.uniform(1, 10))}
        if model == "additive":
            task["curve"]["merge"] = float(rng.uniform(0, 0.2))
    values["budgets_mb"]["wireless"] = float(rng.uniform(60, 200) * tasks)
    return values


@pytest.mark.parametrize("objective", ["weighted", "max-min"])
@pytest.mark.parametrize(("model", "seed"), [*product(MODELS, range(3))])
def test_plans_with_labels_are_the_best_of_all_and_no_bound_is_above(model: str, seed: int, objective: str) -> None:
    values = costly(seed, 2, model, objective=objective)
    best, plan = searched(values), allocate(parsed(values))
    assert plan.objective == pytest.approx(best, rel=1e-8)
    assert plan.lower_bound is not None
    assert plan.lower_bound <= best * (1 + 1e-9)


@pytest.mark.parametrize(("model", "seed"), [*product(MODELS, range(3))])
def test_any_dual_of_a_plan_proves_no_more_than_the_best_of_all_plans_has(model: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for objective in ("weighted", "max-min"):
        problem = parsed(values := costly(seed, 2, model, objective=objective)).model_dump()
        best, k = searched(values), values["edge_rounds_per_cloud_round"]
        tasks, budgets = read_tasks(problem, k)
        branches = [each for each in list_branches(tasks) if np.all(least_cost(each) <= budgets)]
        for _ in range(15):
            drawn = np.array([exact(each) for each in 10 ** rng.uniform(-5, -1, len(budgets))])
            level = best * rng.uniform(0.5, 1.3)
            if objective == "weighted":
                bounds = [bound_weighted(branch, drawn, budgets, k) for branch in branches]
            else:
                bounds = [bound_largest(branch, drawn, level, budgets, k) for branch in branches]
            assert min(bounds) <= best


def made_plan(objective: str = "weighted", **more: Any) -> tuple[Data, Data]:
    problem = parsed(written(4, 5, "additive", budget=700.0) | {"objective": objective} | more)
    return problem.model_dump(), asdict(allocate(problem))


def lower(plan: Data, *path: Any, by: float) -> None:
    place = plan
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = type(place[path[-1]])(place[path[-1]] * by)


def change_counts(_: Data, plan: Data) -> None:
    plan["tasks"][0]["samples"] += 30


def exceed_limits(problem: Data, _: Data) -> None:
    problem["tasks"][0]["limits"]["samples"] = (0, 99)


def scale_dual(_: Data, plan: Data) -> None:
    plan["certificate"] = [
        {**each, "multipliers": [0.98 * m for m in each["multipliers"]]} for each in plan["certificate"]
    ]


@pytest.mark.parametrize(
    ("tamper", "named"),
    [
        (lambda problem, plan: lower(plan, "used_mb", "wireless_mb", by=0.98), "the megabytes"),
        (lambda problem, plan: lower(plan, "tasks", 1, "wireline_mb", by=0.98), "the megabytes"),
        (lambda problem, plan: lower(problem, "budgets_mb", "wireless", by=0.98), "the budgets"),
        (lambda problem, plan: lower(plan, "objective", by=0.98), "the objective"),
        (lambda problem, plan: lower(plan, "lower_bound", by=1.02), "the lower bound"),
        (lambda problem, plan: lower(plan, "lower_bound", by=0.98), "the gap"),
        (lambda problem, plan: lower(plan, "gap", by=0.5), "the gap"),
        (lambda problem, plan: plan.update(status="feasible"), "the status"),
        (lambda problem, plan: plan.update(gap=0.003, lower_bound=plan["objective"] / 1.003), "the status"),
        (lambda problem, plan: plan.update(certificate=[]), "the duals"),
        (change_counts, "the megabytes"),
        (exceed_limits, "the limits"),
        (scale_dual, "the duals"),
    ],
)
def test_a_plan_that_was_tampered_with_is_refused(tamper: Callable[[Data, Data], None], named: str) -> None:
    problem, plan = made_plan()
    assert not verify_allocation(json.dumps(problem), json.dumps(plan)).faults
    tamper(problem, plan)
    assert named in verify_allocation(json.dumps(problem), json.dumps(plan)).faults


def test_a_plan_a_billionth_beyond_a_budget_is_refused() -> None:
    problem, plan = made_plan()
    for share, faults in ((1.0, ()), (1 - 1e-10, ("the budgets",))):
        problem["budgets_mb"] |= {"wireless": plan["used_mb"]["wireless_mb"] * share}
        found = verify_allocation(json.dumps(problem), json.dumps(plan)).faults
        assert ("the budgets" in found) == bool(faults)


def test_a_negative_multiplier_proves_nothing() -> None:
    problem, plan = made_plan()
    plan["certificate"][0]["multipliers"] = [-1.0, 0.0]
    assert "the duals" in verify_allocation(json.dumps(problem), json.dumps(plan)).faults


def test_a_level_that_was_raised_is_refused() -> None:
    problem, plan = made_plan("max-min")
    assert not verify_allocation(json.dumps(problem), json.dumps(plan)).faults
    plan["certificate"][0]["bound"] *= 1.02
    assert "the duals" in verify_allocation(json.dumps(problem), json.dumps(plan)).faults


def test_an_area_has_no_bound_and_says_so() -> None:
    problem, plan = made_plan("area")
    found = verify_allocation(json.dumps(problem), json.dumps(plan))
    assert (found.faults, found.bound, found.gap) == ((), None, None)
    assert "there is no bound for this objective: nothing is proven" in found.lines()[0]
    assert (
        "that there is no bound"
        in verify_allocation(json.dumps(problem), json.dumps(plan | {"lower_bound": 0.1, "gap": 0.0})).faults
    )


def test_what_rests_on_a_search_is_said() -> None:
    values = written(1, 3, "additive", SMALL, 300.0)
    plan = allocate(parsed(values))
    found = verify_allocation(parsed(values).model_dump_json(), json.dumps(asdict(plan)))
    assert found.bound is not None
    assert plan.lower_bound is not None
    assert found.bound < plan.lower_bound * (1 - 1e-3)
    assert any("search above the dual" in each for each in found.trusted)


def made_placement(**limit: float) -> tuple[PlacementProblem, Data, float | None]:
    rng = np.random.default_rng(3)
    errors, poles = rng.uniform(0, 100, (60, 3)) * [1, 1, 0.1], rng.uniform(0, 100, (9, 3)) * [1, 1, 0.1]
    weight, of_pole, of_sensor = rng.uniform(0.1, 2, 60), rng.uniform(0.5, 1.5, 9), np.array([4.0, 1.0])
    ranges = np.array([45.0, 18.0])
    asked = PlacementProblem(errors, weight, poles, ranges, of_pole[:, None] + of_sensor, **limit)  # pyright: ignore[reportArgumentType]
    given = find_candidates(errors, poles, ranges, weight=weight, pole_cost=of_pole, sensor_cost=of_sensor)
    if "budget" in limit:
        return asked, asdict(place_budget(given, limit["budget"])), None
    placed, least = cover_share(given, limit["cover"])
    return asked, asdict(placed), least


def other_pole(placed: Data) -> None:
    free = next(pole for pole in range(9) if pole not in placed["chosen"])
    placed["chosen"] = (*placed["chosen"][:-1], free)


@pytest.mark.parametrize(
    ("tamper", "named"),
    [
        (lambda placed: lower(placed, "cost", by=0.98), "the cost"),
        (lambda placed: lower(placed, "covered_weight", by=1.02), "the errors covered"),
        (lambda placed: placed.update(covered=placed["covered"] + 1), "the errors covered"),
        (lambda placed: placed.update(upper_bound=0.98 * placed["covered_weight"]), "the upper bound"),
        (lambda placed: placed["certificate"].update(search=None), "the upper bound"),
        (
            lambda placed: placed["certificate"].update(values=[0.98 * u for u in placed["certificate"]["values"]]),
            "the dual's bound",
        ),
        (
            lambda placed: placed["certificate"].update(values=[1.02 * u for u in placed["certificate"]["values"]]),
            "the dual",
        ),
        (lambda placed: placed["certificate"].update(price=-0.1), "the dual"),
        (lambda placed: lower(placed, "certificate", "bound", by=0.98), "the dual's bound"),
        (lambda placed: placed.update(optimal=not placed["optimal"]), "whether it is optimal"),
        (lambda placed: placed.update(chosen=(*placed["chosen"][:-1], placed["chosen"][0])), "one sensor a pole"),
        (other_pole, "the errors covered"),
    ],
)
def test_a_placement_that_was_tampered_with_is_refused(tamper: Callable[[Data], None], named: str) -> None:
    asked, placed, _ = made_placement(budget=11.0)
    assert placed["certificate"]["search"] is not None
    assert not verify_placement(asked, json.dumps(placed)).faults
    tamper(placed)
    assert named in verify_placement(asked, json.dumps(placed)).faults


def test_a_placement_beyond_its_budget_is_refused() -> None:
    _, placed, _ = made_placement(budget=11.0)
    asked, _, _ = made_placement(budget=6.0)
    assert "the limit" in verify_placement(asked, json.dumps(placed)).faults


@pytest.mark.parametrize(("by", "named"), [(1.02, "the bound on the cost"), (0.98, "whether it is optimal")])
def test_a_bound_on_the_cost_that_was_changed_is_refused(by: float, named: str) -> None:
    asked, placed, least = made_placement(cover=0.5)
    assert least is not None

    def verified(bound: float) -> Verification:
        return verify_placement(asked, json.dumps(placed), bound)

    assert not verified(least).faults
    assert named in verified(by * least).faults


def test_errors_on_the_sphere_of_a_range_are_covered_and_those_beyond_are_not() -> None:
    errors = np.array([[0.3, 0.4, 0.0], [0.0, 0.5, 0.0], [0.3, 0.4, 1e-7]])
    poles, ranges = np.zeros((1, 3)), np.array([0.5])
    given = find_candidates(errors, poles, ranges).at_unit_cost()
    placed = place_budget(given, 1.0)
    assert placed.covered == 2
    assert not verify_placement(
        PlacementProblem(errors, np.ones(3), poles, ranges, np.ones((1, 1)), budget=1.0), json.dumps(asdict(placed))
    ).faults
