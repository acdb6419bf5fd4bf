from pathlib import Path
from typing import Any

import pytest

from flcav.experiments.fig3a import article_graph
from flcav.experiments.plan_page import SHOWN, plan_page, plan_results
from flcav.optimization.allocation import allocate
from flcav.optimization.budget_sweep import budget_sweep
from flcav.optimization.graph import read_problem
from flcav.optimization.problem import Problem, Uplink
from flcav.optimization.vehicles import vehicle_shares

RECIPES = Path(__file__).parents[3] / "recipes"
ONE = read_problem(RECIPES / "allocation" / "objects.yaml")
LINKS = {f"car {i}": Uplink(wireless=mbps) for i, mbps in enumerate((12, 9, 15, 3, 10, 11, 8), start=1)}
FLEET = ONE.model_copy(update={"tasks": (ONE.tasks[0].model_copy(update={"uplink_mbps": LINKS}),), "horizon_s": 1800.0})


def results_of(problem: Problem) -> dict[str, Any]:
    plan = allocate(problem)
    return plan_results(problem, plan, vehicle_shares(problem, plan.tasks))


def test_a_larger_budget_errs_no_more_and_its_own_budget_is_the_plan() -> None:
    sweep = budget_sweep(ONE, factors=(0.5, 1.0, 2.0))
    errors = [point.objective for point in sweep]
    assert errors == sorted(errors, reverse=True)
    assert sweep[1].objective == allocate(ONE).objective
    assert sweep[2].budgets_mb.wireless_mb == 2 * ONE.budgets_mb.wireless
    alone = budget_sweep(ONE, ("wireline",), factors=(2.0,))[0]
    assert (alone.budgets_mb.wireless_mb, alone.budgets_mb.wireline_mb) == (4000, 8000)


def test_budgets_that_allow_no_plan_are_left_out() -> None:
    assert [point.factor for point in budget_sweep(ONE, factors=(0.01, 1.0))] == [1.0]


@pytest.fixture(scope="module")
def fleet() -> dict[str, Any]:
    return results_of(FLEET)


def test_parts_add_up_to_what_the_plan_uses(fleet: dict[str, Any]) -> None:
    for link, used in fleet["links"].items():
        assert sum(row["mb"] for row in fleet["parts"] if row["link"] == link) == pytest.approx(used["used_mb"])


def test_vehicles_add_up_to_what_the_plan_uses(fleet: dict[str, Any]) -> None:
    assert sum(row["mb"] for row in fleet["vehicles"]) == pytest.approx(fleet["links"]["wireless"]["used_mb"])
    assert all(row["busy_s"] <= (FLEET.horizon_s or 0.0) + 1e-6 for row in fleet["vehicles"])
    assert fleet["sentences"]["vehicles"].startswith(
        "Every vehicle joins every round. The busiest link is that of car 4"
    )


def test_stragglers_are_named() -> None:
    results = results_of(FLEET.model_copy(update={"horizon_s": 900.0}))
    assert (
        "Rounds that a vehicle leaves out because its link cannot carry them: car 4 ("
        in (results["sentences"]["vehicles"])
    )


def test_a_link_that_does_not_bind_is_worth_nothing_more(fleet: dict[str, Any]) -> None:
    assert "MB of the wireline budget are used; more of it would not lower the error." in fleet["sentences"]["links"]
    assert "1,000 MB more would lower the error by about" in fleet["sentences"]["links"]


def test_many_tasks_are_drawn_as_a_few(fleet: dict[str, Any]) -> None:
    tasks = [ONE.tasks[0].model_copy(update={"name": f"task {i}", "sample_mb": 0.1 + 0.1 * i}) for i in range(8)]
    budgets = ONE.budgets_mb.model_copy(update={"wireless": 40000.0, "wireline": 40000.0})
    many = results_of(ONE.model_copy(update={"tasks": tuple(tasks), "budgets_mb": budgets}))
    names = {row["task"] for row in many["parts"]}
    assert len(names) == SHOWN + 1
    assert f"{8 - SHOWN} other tasks" in names
    for link, used in many["links"].items():
        assert sum(row["mb"] for row in many["parts"] if row["link"] == link) == pytest.approx(used["used_mb"])


def test_half_a_budget_that_allows_nothing_is_said() -> None:
    small = ONE.budgets_mb.model_copy(update={"wireless": 300.0})
    sentences = results_of(ONE.model_copy(update={"budgets_mb": small}))["sentences"]
    assert "With half of both budgets the error would be nothing" not in sentences["budgets"]
    assert "half of both budgets no plan fits" in sentences["budgets"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("objective", "words"),
    [("max-min", ("largest predicted error", "This is proven", "1,000 MB more would lower the largest error")),
     ("area", ("area of the predicted accuracies", "not proven", "several local optima", "would raise the area"))],
)  # fmt: skip
def test_other_objectives_are_called_what_they_are(objective: str, words: tuple[str, ...]) -> None:
    tasks = tuple(ONE.tasks[0].model_copy(update={"name": name, "sample_mb": mb}) for name, mb in zip("abc", (1, 2, 3)))
    asked = ONE.model_copy(update={"tasks": tasks, "objective": objective})
    page = plan_page(asked, allocate(asked), {})
    for each in words:
        assert each in page


def test_simpler_plans_stand_beside(fleet: dict[str, Any]) -> None:
    assert all(other["objective"] >= fleet["objective"] * (1 - 1e-9) for other in fleet["others"])
    best = min(fleet["others"], key=lambda other: other["objective"])
    behind = best["objective"] / fleet["objective"] - 1
    said = f"{behind:.2%} behind this plan" if behind > 0 else "no worse than this plan"
    assert best["name"] in fleet["sentences"]["others"]
    assert said in fleet["sentences"]["others"]


def test_a_graph_is_drawn_where_there_is_one() -> None:
    plan = allocate(FLEET)
    assert plan_page(FLEET, plan, {}, article_graph()).count("<img") == 4


def test_the_page_needs_nothing_but_itself_and_tells_the_plan() -> None:
    plan = allocate(FLEET)
    page = plan_page(FLEET, plan, vehicle_shares(FLEET, plan.tasks))
    assert page.count("data:image/png;base64,") == page.count("<img") == 3
    for absent in ("<script", "<link", "http", "None", "nan"):
        assert absent not in page.split("data:image")[0], absent
    assert f"{plan.objective:.4f}" in page
    assert "<td>car 4</td>" in page
