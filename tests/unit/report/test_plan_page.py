import re
from html import unescape
from pathlib import Path
from typing import Any

import networkx as nx
import pytest

from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.allocation.budget_sweep import compute_savings
from flcav.optimization.allocation.comparison import PlanComparison, compare_plan
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.problem_file import STEPS, TERMS
from flcav.optimization.graph import load_problem
from flcav.optimization.problem import Budgets, Limits, Problem, UpdateForm, Uplink
from flcav.report.pages.plan_page import SHOWN, plan_page, plan_results
from flcav.reproductions.fig3a.run import article_graph

RECIPES = Path(__file__).parents[3] / "recipes"
ONE = load_problem(RECIPES / "allocation" / "objects.yaml")
LINKS = {f"car {i}": Uplink(wireless=mbps) for i, mbps in enumerate((12, 9, 15, 3, 10, 11, 8), start=1)}
FLEET = ONE.model_copy(update={"tasks": (ONE.tasks[0].model_copy(update={"uplink_mbps": LINKS}),), "horizon_s": 1800.0})


def compared(problem: Problem) -> PlanComparison:
    plan, shares = allocate_fleet(problem)
    return compare_plan(problem, plan, shares, compute_savings(problem, plan))


def results_of(problem: Problem) -> dict[str, Any]:
    return plan_results(compared(problem))


def page_of(problem: Problem, graph: nx.Graph | None = None) -> str:
    return plan_page(compared(problem), graph)


@pytest.fixture(scope="module")
def fleet() -> dict[str, Any]:
    return results_of(FLEET)


@pytest.fixture(scope="module")
def page() -> str:
    return page_of(FLEET, article_graph())


def test_parts_add_up_to_what_the_plan_uses(fleet: dict[str, Any]) -> None:
    for link, used in fleet["links"].items():
        assert sum(row["mb"] for row in fleet["parts"] if row["link"] == link) == pytest.approx(used["used_mb"])


def test_parts_of_updates_in_a_chosen_form_add_up_and_the_page_names_it() -> None:
    limits = Limits(samples=(100, 100), edge_rounds=(0, 9), cloud_rounds=(0, 2))
    task = ONE.tasks[0].model_copy(update={"limits": limits, "forms": {"int4": UpdateForm(loss=0.01)}})
    problem = ONE.model_copy(update={"tasks": (task,)})
    found = results_of(problem)
    for link, used in found["links"].items():
        assert sum(row["mb"] for row in found["parts"] if row["link"] == link) == pytest.approx(used["used_mb"])
    assert found["links"]["wireless"]["used_mb"] == pytest.approx(100 * 1.6 + (9 + 2) * 7 * 60 / 8)
    assert "<small>updates in int4</small>" in page_of(problem)


def test_vehicles_add_up_to_what_the_plan_uses(fleet: dict[str, Any]) -> None:
    assert sum(row["mb"] for row in fleet["vehicles"]) == pytest.approx(fleet["links"]["wireless"]["used_mb"])
    assert all(row["busy_s"] <= (FLEET.horizon_s or 0.0) + 1e-6 for row in fleet["vehicles"])
    assert fleet["sentences"]["vehicles"].startswith(
        "Every vehicle joins every round. The busiest link is that of car 4"
    )


@pytest.mark.slow
def test_stragglers_are_named() -> None:
    results = results_of(FLEET.model_copy(update={"horizon_s": 900.0}))
    assert (
        "Rounds that a vehicle leaves out because its link cannot carry them: car 4 ("
        in (results["sentences"]["vehicles"])
    )


def test_more_of_a_budget_is_said_as_solved_anew(fleet: dict[str, Any]) -> None:
    sentence = fleet["sentences"]["links"]
    assert "MB of the wireline budget are used; up to 50% more of it would not lower the weighted error." in sentence
    tenth, half = (
        allocate(FLEET.model_copy(update={"budgets_mb": Budgets(wireless=factor * 4000, wireline=4000)})).objective
        for factor in (1.1, 1.5)
    )
    by = f"{fleet['objective'] - tenth:.2g} (10% more) or {fleet['objective'] - half:.2g} (50% more)"
    assert f"more of it would lower the weighted error by {by}." in sentence


@pytest.mark.slow
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
    assert "half of both budgets no plan fits" in sentences["budgets"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("objective", "words"),
    [("max-min", ("predicted largest error", "proven for the fitted", "more of it would lower the largest error")),
     ("area", ("predicted area", "not proven", "several local optima", "would raise the area"))],
)  # fmt: skip
def test_other_objectives_are_called_what_they_are(objective: str, words: tuple[str, ...]) -> None:
    tasks = tuple(ONE.tasks[0].model_copy(update={"name": name, "sample_mb": mb}) for name, mb in zip("abc", (1, 2, 3)))
    asked = ONE.model_copy(update={"tasks": tasks, "objective": objective})
    page = page_of(asked)
    for each in words:
        assert each in page


def test_simpler_plans_stand_beside(fleet: dict[str, Any]) -> None:
    assert all(other["objective"] >= fleet["objective"] * (1 - 1e-9) for other in fleet["others"])
    best = min(fleet["others"], key=lambda other: other["objective"])
    behind = best["objective"] / fleet["objective"] - 1
    said = f"{behind:.2%} behind this plan" if behind > 0 else "no worse than this plan"
    assert best["name"] in fleet["sentences"]["others"]
    assert said in fleet["sentences"]["others"]


def test_the_page_needs_nothing_but_itself_and_tells_the_plan(page: str) -> None:
    assert page.count("data:image/png;base64,") == page.count("<img") == 3
    for absent in ("<script", "<link", "http", "None", "nan"):
        assert absent not in page.split("data:image")[0], absent
    told = re.sub("<[^>]*>", "", unescape(page))
    for sentence in (
        *STEPS.values(),
        *(TERMS[name] for name in ("error", "weighted error", "budget", "saved", "proven")),
    ):
        assert sentence in told
    assert f"{allocate(FLEET).objective:.4f}" in page
    assert "<td>car 4</td>" in page


def test_weights_are_those_that_the_plan_is_made_by() -> None:
    limits = Limits(samples=(100, 110), edge_rounds=(0, 1), cloud_rounds=(0, 1))
    tasks = tuple(
        ONE.tasks[0].model_copy(update={"name": name, "performance_without": without, "limits": limits})
        for name, without in (("a", 0.5), ("b", 0.7))
    )
    results = results_of(ONE.model_copy(update={"tasks": tasks, "performance": 0.8}))
    assert [task["weight"] for task in results["tasks"]] == pytest.approx([0.75, 0.25])


def test_simpler_plans_that_links_do_not_carry_are_no_match() -> None:
    few = {"edge_groups": (1, 1), "uplink_mbps": {"a": Uplink(wireless=9), "b": Uplink(wireless=3)}}
    limits = Limits(samples=(100, 101), edge_rounds=(0, 2), cloud_rounds=(0, 0))
    tasks = (ONE.tasks[0].model_copy(update={**few, "limits": limits}),)
    results = results_of(ONE.model_copy(update={"tasks": tasks, "horizon_s": 250.0}))
    assert "own links" in results["note"]
    assert all(other["note"] is not None for other in results["others"])
    assert results["sentences"]["others"].startswith("None of the simpler plans can be carried out")
