"""Paired comparison of two networks: against a bootstrap by hand, and as the command prints it."""

import json
from pathlib import Path

import numpy as np
import pytest

from flcav.cli.main import run
from flcav.config import InputError, parse_config
from flcav.dataset.recording.recorder import record
from flcav.perception.outcomes import Outcomes, compare_outcomes
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import save_network
from flcav.sources.recipe import Recipe

SCENES = np.repeat(["a", "b", "c", "d"], [3, 2, 4, 3])
RIGHT = np.array([1, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0, 0], bool)
BETTER = np.array([1, 1, 1, 0, 1, 1, 1, 1, 0, 1, 0, 1], bool)


def outcomes_of(right: np.ndarray) -> Outcomes:
    """Return the outcomes of a weather network that is right on some frames."""
    labels = np.zeros(len(right), np.int64)
    return Outcomes(SCENES, {"truth": labels, "named": np.where(right, 0, 1)})


@pytest.mark.parametrize(("first", "second", "said"), [(RIGHT, BETTER, "held"), (BETTER, RIGHT, "did not hold")])
def test_a_comparison_is_a_bootstrap_over_scenes(first: np.ndarray, second: np.ndarray, said: str):
    found = compare_outcomes(WEATHER, outcomes_of(first), outcomes_of(second), len(SCENES))
    assert (found.first, found.second) == pytest.approx((first.mean(), second.mean()))
    change, names = second.astype(float) - first, np.unique(SCENES)
    sums = np.array([change[name == SCENES].sum() for name in names])
    sizes = np.array([(name == SCENES).sum() for name in names])
    drawn = np.random.default_rng(0).integers(len(names), size=(40_000, len(names)))
    means = sums[drawn].sum(1) / sizes[drawn].sum(1)
    assert found.difference.mean == pytest.approx(change.mean())
    ends = tuple(np.quantile(means, [0.025, 0.975]))
    assert (found.difference.low, found.difference.high) == pytest.approx(ends, abs=0.03)
    assert found.verdict == said
    assert said in found.lines()[0]


def test_what_is_not_of_the_same_kind_is_refused():
    one = outcomes_of(RIGHT)
    other = Outcomes(SCENES, {**one.arrays, "range": np.zeros(1)})
    with pytest.raises(InputError, match="look for different things"):
        compare_outcomes(WEATHER, one, other, 12)


def test_one_scene_has_no_interval():
    one, other = (
        Outcomes(each.scene[:3], {name: array[:3] for name, array in each.arrays.items()})
        for each in map(outcomes_of, (RIGHT, BETTER))
    )
    found = compare_outcomes(WEATHER, one, other, 3)
    assert (found.difference.low, found.verdict) == (None, "undecided")
    assert "(no interval)" in found.lines()[0]


def test_the_command_compares_two_files_of_weights(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    few = {"town": "grid", "scenes": 2, "cavs": 1, "spins_per_scene": 2, "warmup_s": 5.0}
    record(parse_config(Recipe, {**WEATHER.recording, **few}, "few"), tmp_path / "data")
    config = next(iter(WEATHER.configurations.values()))
    for name in ("one", "other"):
        save_network(WEATHER, WEATHER.build(config), tmp_path / f"{name}.safetensors")
    weights = [str(tmp_path / f"{name}.safetensors") for name in ("one", "other")]

    def call(*options: str) -> tuple[object, str, str]:
        with pytest.raises(SystemExit) as ended:
            run(["compare", *options])
        told = capsys.readouterr()
        return ended.value.code, told.out, told.err

    data = str(tmp_path / "data")
    code, said, _ = call(*weights, "--data", data, "--task", "weather", "--json")
    found = json.loads(said)
    assert (code, found["task"], found["frames"], found["scenes"]) == (0, "weather", 4, 2)
    assert found["difference"]["mean"] == pytest.approx(found["second"] - found["first"])
    code, _, wrong = call(*weights, "--data", data)
    assert (code, "weights without a card" in wrong) == (2, True)
    code, _, wrong = call(data, weights[1], "--data", data)
    assert (code, "a folder; with --data two files of weights" in wrong) == (2, True)
    code, said, _ = call(*weights, "--data", data, "--task", "weather", "--agents", "vehicles")
    assert (code, "over 4 frames of 2 scenes" in said) == (0, True)
    code, _, wrong = call(*weights, "--agents", "all")
    assert (code, "--agents: only two networks have one" in wrong) == (2, True)
    code, _, wrong = call(*weights, "--task", "weather")
    assert (code, "--task: only two networks have one" in wrong) == (2, True)
