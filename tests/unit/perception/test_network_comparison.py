"""Paired comparison of two networks: against a bootstrap by hand, and as the command prints it."""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flcav.cli.main import run
from flcav.config import InputError, parse_config
from flcav.dataset.recording.recorder import record
from flcav.geometry import Boxes, concatenate
from flcav.interface.progress import ignore_progress
from flcav.perception.comparing import compare
from flcav.perception.objects import predict
from flcav.perception.objects.config import paper_config, tiny_config
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import Outcomes, compare_outcomes
from flcav.perception.signs import evaluate as signs_evaluate
from flcav.perception.signs.predict import SignDetections
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import build_network
from flcav.perception.tasks import task_named
from flcav.perception.trajectory import evaluate as trajectory_evaluate
from flcav.perception.trajectory.config import FUTURE, PAST
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import save_network
from flcav.sensors.frame import Frame
from flcav.sources.recipe import Recipe

from .frames import detections, frame

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


def found_by(rows: dict[int, list[tuple[str, float, float, float]]]):
    """Return a detector that finds rows (class, x, y, score) in the frame of each number."""

    def detect(_network: Any, frames: Sequence[Frame], **_: Any) -> list[Boxes]:
        own = rows[frames[0].index]
        return [concatenate([Boxes.empty(), *(detections((x, y, s), label=name) for name, x, y, s in own)])]

    return detect


def test_detectors_of_other_ranges_and_classes_are_compared_on_what_both_look_for(monkeypatch: pytest.MonkeyPatch):
    """The wide network's far car, its pedestrian and its false box behind the narrow one's range do not count."""
    seen = [("near", "car", 10, 0, 50), ("far", "car", 60, 0, 50), ("walker", "pedestrian", 12, -6, 20)]
    frames = [frame(seen, scene=f"s{number}", index=number) for number in range(2)]
    data: Any = SimpleNamespace(frame=frames.__getitem__)
    narrow, wide = (SimpleNamespace(config=make()) for make in (tiny_config, paper_config))
    asked = OBJECTS.share_targets([narrow.config, wide.config])
    assert OBJECTS.describe_targets(asked) == "Car, 0 to 48 m ahead and 24 m to either side"
    assert OBJECTS.describe_targets(OBJECTS.share_targets([wide.config, narrow.config])) == OBJECTS.describe_targets(
        asked
    )
    wide_rows = [("Car", 10.0, 0.0, 0.9), ("Car", 60.0, 0.0, 0.8), ("Car", 65.0, 30.0, 0.95)]
    monkeypatch.setattr(predict, "detect_in", found_by({0: wide_rows, 1: wide_rows}))
    of_wide = OBJECTS.outcomes(wide, data, range(2), asked=asked)  # type: ignore[arg-type]
    monkeypatch.setattr(predict, "detect_in", found_by({0: [("Car", 10.0, 0.0, 0.9)], 1: []}))
    of_narrow = OBJECTS.outcomes(narrow, data, range(2), asked=asked)  # type: ignore[arg-type]
    found = compare_outcomes(OBJECTS, of_narrow, of_wide, 2, OBJECTS.describe_targets(asked))
    assert (found.first, found.second) == (0.5, 1.0)
    assert OBJECTS.numbers(of_wide)["targets"] == OBJECTS.numbers(of_narrow)["targets"] == 2
    assert found.lines()[1] == "on what both look for: Car, 0 to 48 m ahead and 24 m to either side"
    monkeypatch.setattr(predict, "detect_in", found_by({0: wide_rows, 1: wide_rows}))
    assert OBJECTS.numbers(OBJECTS.outcomes(wide, data, range(2)))["targets"] == 6  # type: ignore[arg-type]


def test_networks_with_nothing_in_common_are_refused():
    behind = replace(tiny_config(), range_m=(-48.0, -24.0, -3.0, 0.0, 24.0, 1.0))
    with pytest.raises(InputError, match=r"nothing in common: Car, 0 to 48 m ahead .*; Car, -48 to 0 m ahead"):
        OBJECTS.share_targets([tiny_config(), behind])
    with pytest.raises(InputError, match=r"nothing in common: signs: .*; actors: car, van of 10 px or more"):
        SIGNS.share_targets([SIGNS.configurations["n"], SIGNS.configurations["road"]])


def test_sign_detectors_of_other_classes_are_compared_on_the_common_ones(monkeypatch: pytest.MonkeyPatch):
    """Numbers of classes differ between the networks: what is found is renumbered, and what one lacks is dropped."""
    first, second = SIGNS.configurations["n"].classes[:2]
    both = replace(SIGNS.configurations["n"], classes=(first, second))
    alone = replace(both, classes=(second,), smallest_px=9.0)
    asked = SIGNS.share_targets([both, alone])
    assert (asked.classes, asked.smallest_px) == ((second,), 9.0)
    box = np.array([[10.0, 10.0, 30.0, 30.0], [50.0, 10.0, 70.0, 30.0]])
    picture = SimpleNamespace(picture=None, boxes=box[1:], label=np.array([0]), ignore=np.zeros((0, 4)))

    class Pictures(list):
        def scene(self, number: int) -> str:
            return f"s{number}"

    monkeypatch.setattr(signs_evaluate, "_last_asked_for", lambda *_: Pictures([picture, picture]))
    seen = SignDetections(box, np.array([0, 1]), np.array([0.9, 0.8]))
    monkeypatch.setattr(signs_evaluate, "detect_in_picture", lambda *_, **__: seen)
    network: Any = SimpleNamespace(config=both)
    kept = SIGNS.outcomes(network, SimpleNamespace(), range(2), asked=asked).arrays  # type: ignore[arg-type]
    assert kept["found/label"].tolist() == [0, 0]
    assert np.array_equal(kept["found/box"], box[[1, 1]])


def test_forecasts_of_more_modes_count_by_their_likeliest(monkeypatch: pytest.MonkeyPatch):
    few, many = (replace(TRAJECTORY.configurations["tiny"], modes=count) for count in (1, 3))
    asked = TRAJECTORY.share_targets([many, few])
    assert TRAJECTORY.describe_targets(asked) == "paths of all vehicles, in 1 modes"
    future = np.zeros((2, FUTURE, 2))
    off = np.stack([future + away for away in (0.0, 1.0, 3.0)], axis=1)  # the best mode is the least likely
    columns = SimpleNamespace(future=future, past=np.zeros((2, PAST + 1, 4)), scene=np.array(["a", "b"]))
    monkeypatch.setattr(trajectory_evaluate, "samples_of", lambda *_: SimpleNamespace(columns=columns))
    monkeypatch.setattr(trajectory_evaluate, "predict_paths", lambda *_: (off, np.array([[0.2, 0.5, 0.3]] * 2)))
    network: Any = SimpleNamespace(config=many)
    errors = TRAJECTORY.outcomes(network, SimpleNamespace(), (), asked=asked).arrays  # type: ignore[arg-type]
    assert errors["minFDE_K"] == pytest.approx(np.sqrt(2.0))
    errors = TRAJECTORY.outcomes(network, SimpleNamespace(), ()).arrays  # type: ignore[arg-type]
    assert errors["minFDE_K"] == pytest.approx(0.0)


OWN = """
from flcav.perception.weather.task import WeatherTask
class Sky(WeatherTask):
    name, family = "sky", "clouds"
    configurations = {"few": __import__("dataclasses").replace(WeatherTask.configurations["tiny"], classes=CLASSES)}
SKY = Sky()
class Other:
    name, family, configurations, practice = "weather", "other", {}, None
    build = samples = draw = loss = evaluate = infer = None
OTHER = Other()
"""


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of four pictures in two scenes."""
    folder = tmp_path_factory.mktemp("pictures") / "data"
    few = {"town": "grid", "scenes": 2, "cavs": 1, "spins_per_scene": 2, "warmup_s": 5.0}
    record(parse_config(Recipe, {**WEATHER.recording, **few}, "few"), folder)
    return folder


def test_a_network_of_ones_own_is_compared_with_the_packaged_one(
    pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [str(tmp_path), *sys.path])
    classes = WEATHER.configurations["tiny"].classes
    Path("own_clouds.py").write_text(OWN.replace("CLASSES", repr(classes[1:])), encoding="utf-8")
    task = task_named("own_clouds:SKY")
    save_network(task, build_network(task, task.configurations["few"], 1), Path("mine.safetensors"))
    found = [
        compare(task, pictures, *sides, progress=ignore_progress)
        for sides in (("packaged", "mine.safetensors"), ("mine.safetensors", None))
    ]
    assert found[0].difference.mean == pytest.approx(-found[1].difference.mean)
    assert found[0].targets == f"pictures of {', '.join(sorted(classes[1:]))}"
    by_pair = compare(("weather", "own_clouds:SKY"), pictures, "packaged", "mine.safetensors", progress=ignore_progress)
    assert by_pair.difference == found[0].difference
    with pytest.raises(InputError, match=r"'clouds'.*a network of your own has a task of your own, named module:NAME"):
        compare("weather", pictures, "packaged", "mine.safetensors", progress=ignore_progress)
    with pytest.raises(InputError, match="measured by different things, mean score of a scene of 'weather' and acc"):
        compare(("own_clouds:OTHER", "weather"), pictures, task.build(task.configurations["few"]), None)


def test_the_command_compares_two_files_of_weights(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = next(iter(WEATHER.configurations.values()))
    for name in ("one", "other"):
        save_network(WEATHER, WEATHER.build(config), tmp_path / f"{name}.safetensors")
    weights = [str(tmp_path / f"{name}.safetensors") for name in ("one", "other")]

    def call(*options: str) -> tuple[object, str, str]:
        with pytest.raises(SystemExit) as ended:
            run(["compare", *options])
        told = capsys.readouterr()
        return ended.value.code, told.out, told.err

    data = str(pictures)
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
    code, said, _ = call("packaged", weights[1], "--data", data, "--task", "weather", "--task", "weather")
    assert (code, "over 4 frames of 2 scenes" in said) == (0, True)
    code, _, wrong = call("packaged", "packaged", "--data", data)
    assert (code, "--task is missing: of which task" in wrong) == (2, True)
    code, _, wrong = call(*weights, "--agents", "all")
    assert (code, "--agents: only two networks have one" in wrong) == (2, True)
    code, _, wrong = call(*weights, "--task", "weather")
    assert (code, "--task: only two networks have one" in wrong) == (2, True)
