"""What the cloud adds: numbers of a run, changes against edge FL and pretraining, aims, tables and the picture."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flcav.reproductions.cloud import run as study
from flcav.reproductions.cloud.run import (
    AIMS,
    ARMS,
    CHOSEN,
    EDGES,
    PRETRAINED,
    REGIONS,
    TOWNS,
    CloudResult,
    CloudSeed,
    Score,
)
from flcav.runs.arms import Names, resolve_settings
from flcav.runs.recipe import CLOUD, MAIN, PRETRAIN, load_run_recipe
from flcav.runs.results import tests as saved
from flcav.sources.recipe import recipe_path
from flcav.statistics.estimates import Estimate

RECIPE = load_run_recipe(recipe_path("runs/cloud"))


def seed_of(more: float) -> CloudSeed:
    """Return a seed whose arms are `more` above .6 AP50, in which `ring` has the better network for the unseen town."""
    edges = {"grid": {"grid": 0.7, "arterial": 0.5}, "ring": {"ring": 0.65, "arterial": 0.55}}

    def score(town: str, name: str) -> Score:
        region = next((each for each in REGIONS if EDGES[each] == name), None)
        ap50 = 0.8 if name == PRETRAINED else edges[region].get(town, 0.4) if region else 0.6 + more
        return Score(ap50, ap50 / 2)

    networks = (PRETRAINED, *EDGES.values(), *ARMS)
    return CloudSeed({town: {name: score(town, name) for name in networks} for town in TOWNS}, "ring")


def test_the_arms_are_those_of_the_recipe() -> None:
    assert {*ARMS.values()} == {MAIN, *RECIPE.arms}
    assert CHOSEN in ARMS
    assert tuple(RECIPE.regions) == TOWNS
    assert RECIPE.with_role("federate") == REGIONS


def test_changes_are_against_the_region_s_edge_fl_the_preferred_one_and_pretraining() -> None:
    found = study.compare_cloud(RECIPE, {"1": seed_of(0.0), "2": seed_of(0.04)})
    wanted = {
        "grid, AP50": -0.08,
        "ring, AP50": -0.03,
        "unseen town, AP50": 0.07,
        "home, AP50": -0.18,
        "home, AP70": -0.09,
    }
    assert {aim: found.changes[aim][CHOSEN].mean for aim in AIMS} == pytest.approx(wanted)
    assert found.ap50["ring"][EDGES["ring"]].mean == pytest.approx(0.65)
    assert found.ap70["suburb"][PRETRAINED].mean == pytest.approx(0.4)
    assert CloudResult.from_json(found.as_json(), "x") == found
    shown = study.cloud_tables(found)
    assert f"| {CHOSEN} | -0.080 (" in shown["changes"]
    assert f"| {EDGES['grid']} | 0.400, 0.200 | 0.700, 0.350 | 0.400, 0.200 | 0.500, 0.250 |" in shown["towns"]
    assert "| unseen town, AP50, at least +0.03 | +0.070 (" in shown["aims"]
    assert found.sentences()[0].startswith("*grid, AP50*: **")
    assert study.draw_cloud(found).startswith(b"\x89PNG")


def test_a_seed_is_read_from_its_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Edge FL is tested in the other towns, too, and the better one is chosen on validation frames."""
    names = Names(resolve_settings(RECIPE))
    trained = {PRETRAINED: (MAIN, PRETRAIN), **{name: (arm, CLOUD) for name, arm in ARMS.items()}}
    for number, own in enumerate(trained.values()):
        for place, town in enumerate(TOWNS):
            step = tmp_path / names.test(names.stage(*own, town, "objects"), town)
            step.mkdir()
            made(town, 0.1 * number + 0.01 * place).save(step)
    for region in REGIONS:
        step = tmp_path / names.test(names.edge(MAIN, region, "objects"), region)
        step.mkdir()
        made(region, 0.9).save(step)
    measured = SimpleNamespace(outcomes=lambda network, data, frames: data, numbers=lambda data: {"AP70": 0.2})
    monkeypatch.setattr(study, "load_stage_network", lambda task, folder: folder.name)
    monkeypatch.setattr(study.Frames, "open", lambda folder: SimpleNamespace(data=folder.name, vehicles=(0,)))
    monkeypatch.setattr(study, "as_measurable", lambda task: measured)
    monkeypatch.setattr(study, "compute_measure", lambda task, data: 0.5 if "ring" in data else 0.4)
    monkeypatch.setattr(study, "score_network", lambda task, network, data, frames: "ring" in network and "val" in data)
    seed = study.read_seed(cast(Any, SimpleNamespace(recipe=RECIPE, steps=names)), tmp_path)
    assert seed.preferred == "ring"
    assert seed.scores["grid"][EDGES["grid"]] == Score(0.9, 0.45)
    assert seed.scores["ring"][EDGES["grid"]] == Score(0.5, 0.2)
    assert seed.scores["arterial"][CHOSEN].ap50 == pytest.approx(0.1 * (1 + [*ARMS].index(CHOSEN)) + 0.03)
    assert seed.scores["suburb"][PRETRAINED] == Score(0.0, 0.0)


def made(town: str, ap50: float) -> saved.Tested:
    return saved.Tested(town, "objects", "AP50", Estimate(ap50, None, None), {"AP70": ap50 / 2}, 6, 3)
