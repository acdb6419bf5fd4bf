"""A task's study at toy scale, its steps, and what the studies record."""

import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from studies import STUDIES

from flcav.cli.main import run as command
from flcav.config import InputError, parse_config
from flcav.experiments.experiment import load_experiment
from flcav.experiments.study import (
    list_counts,
    load_own_study,
    make_experiment,
    run_study,
    steps_of,
)
from flcav.perception.study import TEST_SEEDS
from flcav.perception.training.run import CARD, EVENTS, WEIGHTS
from flcav.reproductions.task_weather import run as weather
from flcav.sources.recipe import Recipe

each_study = pytest.mark.parametrize("study", STUDIES.values(), ids=STUDIES)


@each_study
def test_no_two_splits_share_a_scene(study):
    tests = [fields for seed in range(1, 6) for fields in study.recipe.tests_of(seed).values()]
    recipes = [*study.recipe.train, study.recipe.validation, *tests]
    parsed = [parse_config(Recipe, dict(recipe), study.task.name) for recipe in recipes]
    assert len({(recipe.town, recipe.seed) for recipe in parsed}) == len(recipes)
    assert study.recipe.network in study.task.configurations


@each_study
def test_every_seed_is_tested_on_ten_scenes_or_more_of_its_own(study):
    assert all(fields["scenes"] >= 10 for fields in study.recipe.tests.values())
    first, second = ({step.name: step for step in steps_of(study, [seed])} for seed in (1, 2))
    for name in study.recipe.tests:
        recorded = [steps[f"seed-{seed}-test-{name}"] for seed, steps in ((1, first), (2, second))]
        seeds = [step.arguments["recipe"]["seed"] for step in recorded]
        assert seeds[1] - seeds[0] == TEST_SEEDS > max(fields["seed"] for fields in study.recipe.tests.values())
        assert f"seed-1-test-{name}" in first["seed-1-tested"].needs
    assert first["train-0"] == second["train-0"]


@each_study
def test_a_quick_study_is_the_same_with_fewer_scenes_and_epochs(study):
    recipe, quick = study.recipe, study.recipe.at_scale("quick")
    assert recipe.at_scale("full") == recipe
    assert quick.epochs <= recipe.epochs
    assert all(fields["scenes"] <= recipe.quick_scenes for fields in (*quick.train, quick.validation))
    smaller = replace(study, recipe=quick)
    assert {step.name for step in steps_of(smaller, [1])} == {step.name for step in steps_of(study, [1])}
    with pytest.raises(InputError, match="scale 'paper'"):
        recipe.at_scale("paper")


RECORDED = {
    "weather": "e5217e3fd7183127",
    "signs": "af6031549073e2c9",
    "objects": "98f2d23f0988e5c6",
    "objects-streets": "7621a783ce5d6a7b",  # of the third training of the page
    "road": "ac77a8f1e233102d",
    "trajectory": "3b5f95cc2d111a7a",
    "trajectory-cameras": "9889f4d36a9b6fc9",
}


@pytest.mark.parametrize("name", STUDIES)
def test_what_a_study_records_stays_what_its_committed_figures_are_of(name):
    """A recipe that changes, changes the frames, and the steps' fingerprints: run the study anew, then write both."""
    study = STUDIES[name]
    recipe = study.recipe
    recipes = {"train": list(recipe.train), "validation": recipe.validation, "tests": dict(recipe.tests)}
    assert hashlib.sha256(json.dumps(recipes, sort_keys=True).encode()).hexdigest()[:16] == RECORDED[name]


def test_counts_are_said_once_where_all_seeds_have_the_same():
    assert (list_counts([288, 288, 288]), list_counts([33, 30, 33])) == ("288", "33, 30, 33")


def test_a_training_waits_for_its_frames_and_a_test_for_its_training():
    steps = {step.name: step for step in steps_of(weather.STUDY, [1, 2])}
    assert set(steps["seed-2"].needs) == {"train-0", "train-1", "train-2", "validation"}
    tests = {f"seed-2-test-{name}" for name in weather.STUDY.recipe.tests}
    assert set(steps["seed-2-tested"].needs) == {"seed-2", *tests}


def toy(recipe: Any) -> dict[str, Any]:
    """Return a recipe with four frames to record."""
    small = {"cavs": 1, "spins_per_scene": 4, "scenes": 1, "warmup_s": 20.0}
    return {**recipe, **small, "weather": {"classes": ["clear", "night", "clear", "fog"], "turn_s": 4.0}}


RECIPE = weather.STUDY.recipe
OWN = replace(
    weather.STUDY,
    recipe=replace(
        RECIPE,
        train=(toy(RECIPE.train[0]),),
        validation=toy(RECIPE.validation),
        tests={name: toy(RECIPE.tests[name]) for name in ("held-out town", weather.WHOLE_SPACE)},
        epochs=1,
    ),
)


def test_a_study_of_ones_own_is_found_by_its_module(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sys.path", [str(Path(__file__).parent), *sys.path])
    assert load_own_study(f"{Path(__file__).stem}:OWN").recipe.tests.keys() == OWN.recipe.tests.keys()
    with pytest.raises(InputError, match=r"has no 'NONE'"):
        load_own_study(f"{Path(__file__).stem}:NONE")
    with pytest.raises(InputError, match=r"neither a study nor a task with a study"):
        load_own_study("pathlib:Path")
    with pytest.raises(InputError, match=r"neither a folder with a run.py nor one of .*task-weather"):
        load_experiment("none")


def test_the_command_says_what_is_no_study(tmp_path: Path, capsys: pytest.CaptureFixture):
    for target, said in (("no_such_module:STUDY", "no module 'no_such_module'"), ("nothing", "task-weather")):
        with pytest.raises(SystemExit) as stopped:
            command(["reproduce", target, "--out", str(tmp_path / "out")])
        assert stopped.value.code == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_toy_study_gives_numbers_of_each_seed_and_goes_on(tmp_path: Path):
    study = OWN
    said: list[str] = []

    def notify(step: str, done: int, total: int, note: str) -> None:
        said.append(f"{step} {note}")

    results = run_study(study, tmp_path, seeds=[1, 2], jobs=1, notify=notify)
    assert [seed.seed for seed in results.seeds] == [1, 2]
    for seed in results.seeds:
        folder = tmp_path / f"seed-{seed.seed}"
        assert (folder / WEIGHTS).is_file()
        assert (folder / CARD).is_file()
        assert list((folder / EVENTS).iterdir())
        assert seed.card.seed == seed.seed
        assert seed.tests["held-out town"].pictures == 4
    accuracies = [found.accuracy for found in results.tested("held-out town")]
    mean = results.summary["held-out town"]["accuracy"]
    assert mean.mean == pytest.approx(np.mean(accuracies))
    if len(set(accuracies)) > 1:
        assert mean.low is not None
        assert mean.high is not None
        assert 0 < mean.low < mean.mean < mean.high < 1
    assert "nearest class" in results.summary[weather.WHOLE_SPACE]
    experiment = make_experiment(study, lambda read: {"same": str(read == results)})
    values = experiment.encode(results)
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert experiment.tabulate(values, "result.json") == {"same": "True"}
    assert study.draw(results).startswith(b"\x89PNG")

    said.clear()
    assert run_study(study, tmp_path, seeds=[1, 2], jobs=1, notify=notify) == results
    assert all(line.endswith("done before") for line in said)
    with pytest.raises(InputError, match="another configuration"):
        run_study(replace(study, recipe=replace(study.recipe, epochs=2)), tmp_path, seeds=[1, 2], jobs=1, notify=notify)


class Unsaid:
    """A task whose evaluation does not say what it returns."""

    name = "unsaid"

    def evaluate(self, network, data, frames=None):
        return None


def test_a_task_without_an_annotation_of_its_evaluation_is_named_before_anything_is_recorded(tmp_path: Path):
    study: Any = replace(OWN, task=Unsaid())
    with pytest.raises(InputError, match=r"task 'unsaid': its evaluate\(\) has no annotation of the dataclass"):
        run_study(study, tmp_path / "out", seeds=[1], jobs=1, notify=lambda *_: None)
    assert not (tmp_path / "out").exists()
