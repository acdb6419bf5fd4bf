"""Runs that begin with weights that are there: a user's, or those of the package."""

import re
from pathlib import Path
from typing import Any

import pytest

from flcav.config import InputError
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import Ledger
from flcav.perception.tasks import task_named
from flcav.perception.weights import find_shipped, load_network, save_network, to_arrays
from flcav.runs.engine import Work
from flcav.runs.recipe import RunRecipe
from flcav.runs.results.plans import Plan, TaskPlan
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.results.training import Pretrained
from flcav.runs.stages.centralised import pretrain_step
from flcav.runs.stages.graph import Graph
from flcav.runs.training.learning import find_start, load_start

WEATHER = task_named("weather")
SHIPPED = find_shipped(WEATHER)


def recipe(samples: int = 0, **task: Any) -> RunRecipe:
    plan = {"samples": samples, "edge_rounds": 1, "cloud_rounds": 1}
    return RunRecipe.model_validate(
        {
            "size": "toy",
            "tasks": {"weather": {"plan": plan, **task}},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 1}},
            "budgets_mb": {"wireless": 100, "wireline": 100},
            "placement": {"rule": "none"},
        }
    )


def test_without_samples_stage_one_sends_nothing_and_keeps_the_weights_as_they_are(tmp_path: Path) -> None:
    own = recipe(weights="shipped")
    folders = {name: tmp_path / name for name in ("plan", "pretrain")}
    for folder in folders.values():
        folder.mkdir()
    Plan("joint", {"weather": TaskPlan(0, 1, 1, 1.0, 1.0, 0.1, 0.2, None)}).save(folders["plan"])
    step = next(step for step in Graph(own, tmp_path).steps if step.name == "pretrain-weather")
    settings = step.arguments["settings"].model_copy(update={"pools": {}, "validation": (), "plan": "plan"})
    pretrain_step(Work(folders["pretrain"], folders, ignore_progress), settings)
    held = to_arrays(load_network(WEATHER, folders["pretrain"] / WEIGHTS))
    assert all((held[name] == array).all() for name, array in to_arrays(load_network(WEATHER, SHIPPED)).items())
    about = Pretrained.load(folders["pretrain"])
    assert (about.steps, about.validated, about.uploaded) == (0, (), {})
    assert Ledger.load(folders["pretrain"] / LEDGER).entries == ()


def test_a_file_is_found_beside_the_recipe_and_not_loaded_once_it_has_changed(tmp_path: Path) -> None:
    network = load_network(WEATHER, SHIPPED)
    save_network(WEATHER, network, tmp_path / "own.safetensors")
    start = find_start(WEATHER, recipe(weights="own.safetensors").tasks["weather"], tmp_path)
    assert start is not None
    assert to_arrays(load_start(WEATHER, start)).keys() == to_arrays(network).keys()
    (tmp_path / "own.safetensors").write_bytes(find_shipped(task_named("objects")).read_bytes())
    with pytest.raises(InputError, match="the weights were changed while the run was under way"):
        load_start(WEATHER, start)


def test_weights_of_another_network_or_none_are_refused_in_a_sentence(tmp_path: Path) -> None:
    objects = task_named("objects")
    plan = {"plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}, "weights": "shipped"}
    own = RunRecipe.model_validate(recipe(4).model_dump() | {"tasks": {"objects": {**plan, "network": "tiny"}}})
    said = "weights of another network than 'tiny', which the recipe has for 'objects'"
    with pytest.raises(InputError, match=said):
        find_start(objects, own.tasks["objects"], tmp_path)
    with pytest.raises(InputError, match=re.escape(f"there is no file 'none.safetensors' in {tmp_path}")):
        find_start(WEATHER, recipe(samples=4, weights="none.safetensors").tasks["weather"], tmp_path)
