"""Stragglers of a run: how many vehicles train slower, by how much, and what the steps are told of it."""

from pathlib import Path
from typing import Any

import pytest

from flcav.config import InputError, parse_config
from flcav.runs.recipe import RunRecipe, Stragglers, draw_stragglers
from flcav.runs.stages.graph import Graph

RECIPE: dict[str, Any] = {
    "tasks": {"objects": {"history": "objects", "train_s": 2.0}},
    "regions": {
        "suburb": {"role": "pretrain"},
        "grid": {"role": "federate", "vehicles": 8},
        "ring": {"role": "federate", "vehicles": 4, "speed": {"cav0": 2.0}},
    },
    "budgets_mb": {"wireless": 100, "wireline": 80},
    "horizon_s": 40,
    "stragglers": {"share": 0.3, "slower": 3},
}


def read(**changes: Any) -> RunRecipe:
    return parse_config(RunRecipe, {**RECIPE, **changes}, "run.yaml")


@pytest.mark.parametrize(("share", "count"), [(0.3, 2), (0.01, 0), (0.5, 4), (1.0, 8)])
def test_a_share_of_the_vehicles_is_slower(share: float, count: int):
    names = [f"cav{number}" for number in range(8)]
    drawn = draw_stragglers(Stragglers(share=share, slower=4), names, 1, "grid")
    assert len(drawn) == count
    assert set(drawn) <= set(names)
    assert set(drawn.values()) <= {0.25}


def test_the_seed_draws_and_a_speed_that_is_given_wins():
    several = {tuple(read(seed=seed).speeds("grid")) for seed in range(10)}
    assert len(several) > 3
    assert read().speeds("grid") == read().speeds("grid")
    assert read(stragglers={"share": 1.0, "slower": 4}).speeds("ring") == {
        "cav0": 2.0,
        "cav1": 0.25,
        "cav2": 0.25,
        "cav3": 0.25,
    }
    assert read(stragglers=None).speeds("grid") == {}


def test_the_plan_is_told_how_slow_they_are(tmp_path: Path):
    graph = Graph(read(), tmp_path)
    (plan,) = (step.arguments["settings"] for step in graph.steps if step.name == graph.names.plan("main"))
    slow = [name for name, speed in plan.speeds.items() if speed == pytest.approx(1 / 3)]
    assert len([name for name in slow if name.startswith("grid/")]) == 2
    assert len([name for name in slow if name.startswith("ring/")]) in (0, 1)
    assert plan.speeds["ring/cav0"] == 2.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"horizon_s": None}, "time counts with 'horizon_s' or 'federation.network' alone"),
        ({"stragglers": {"share": 0.3, "slower": 1}}, "stragglers.slower"),
        ({"stragglers": {"share": 1.5, "slower": 2}}, "stragglers.share"),
        ({"stragglers": {"slower": 2}}, "stragglers.share"),
    ],
)
def test_what_makes_no_stragglers_is_refused(changes: dict[str, Any], said: str):
    with pytest.raises(InputError, match=said):
        read(**changes)
