"""A run of lifelong learning at toy size: records agree with files, and it goes on after a stop to the same."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from flcav.config import parse_config
from flcav.network.ledger import Ledger
from flcav.report.pages.run_page import write_report
from flcav.runs.recipe import RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.running import WORK, run

pytestmark = pytest.mark.slow

SPLIT = {"scenes": 2, "spins": 2, "cavs": 2}
RECIPE = parse_config(
    RunRecipe,
    {
        "splits": dict.fromkeys(("pool", "validation", "registry", "edge", "test"), SPLIT),
        "training": {"steps": 20, "local_steps": 1},
        "tasks": {"weather": {"train_s": 1.0, "plan": {"samples": 8, "edge_rounds": 2, "cloud_rounds": 0}}},
        "regions": {
            "suburb": {"role": "pretrain", "recording": {"weather": "clear"}},
            "sun": {"role": "federate", "town": "ring", "vehicles": 2, "recording": {"weather": "clear"}},
            "fog": {"role": "federate", "town": "ring", "vehicles": 2, "recording": {"weather": "fog"}},
        },
        "budgets_mb": {"wireless": 90, "wireline": 40},
        "placement": {"rule": "none"},
        "recording": {"warmup_s": 5.0},
        "federation": {"network": {}},
        "lifelong": {
            "conditions": ["sun", "fog"],
            "memory": 2,
            "requests": {"excess": 1.01, "range_m": 10000, "link_s": 1000, "least_quality": 0},
        },
    },
    "recipe",
)
LEARNS, DRIVES = "fog-lifelong-weather-replay", "fog-drives-weather-replay"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("lifelong") / "run"
    run(RECIPE, out)
    return out


def test_records_are_those_of_the_steps(finished: Path) -> None:
    found = Run.load(finished)
    assert found.lifelong is not None
    assert [each.arm for each in found.lifelong] == ["replay", "no replay", "nothing"]
    replay, plain, nothing = found.lifelong
    pretrained = [found.test(stage="pretrain", region=name, task="weather").estimate.mean for name in ("sun", "fog")]
    assert all([*row] == pretrained for row in nothing.tested)
    assert replay.tested[0] == plain.tested[0] == nothing.tested[0]
    for arm in (replay, plain):
        book = Ledger.load(finished / "ledgers" / f"lifelong-{arm.arm.replace(' ', '-')}.parquet")
        assert (book.used_bytes(), book.used_bytes(direction="down")) == (arm.up_bytes, arm.down_bytes)
    assert (nothing.up_bytes, nothing.down_bytes) == (0, 0)
    assert replay.passed[0] == plain.passed[0]  # nothing to remember yet
    fog = replay.passed[1]
    assert fog.asked, "all that was seen before is sun"
    assert (fog.members, fog.rounds) == (2, 2)
    assert len(fog.scores["sun"]) == len(fog.scores["fog"]) == fog.rounds + 1
    assert fog.rounds_s is not None
    assert min(fog.rounds_s) > 1.0
    assert fog.recorded_s == pytest.approx(8.0)  # 4 s in each of two scenes


def test_the_driving_network_is_the_copy_or_the_one_before(finished: Path) -> None:
    work, found = finished / WORK, Run.load(finished)
    assert found.lifelong is not None
    for condition, passed in zip(("sun", "fog"), found.lifelong[0].passed, strict=True):
        before = "pretrain-weather" if condition == "sun" else "sun-drives-weather-replay"
        source = f"{condition}-lifelong-weather-replay" if passed.replaced else before
        weights = [
            load_file(work / name / "weights.safetensors") for name in (f"{condition}-drives-weather-replay", source)
        ]
        assert all(np.array_equal(weights[0][name], weights[1][name]) for name in weights[1])


def test_what_is_remembered_changes_what_is_learned(finished: Path) -> None:
    rounds = [
        load_file(finished / WORK / f"fog-lifelong-weather-{arm}" / "round2.safetensors")
        for arm in ("replay", "no-replay")
    ]
    assert any(not np.array_equal(rounds[0][name], rounds[1][name]) for name in rounds[0])


def test_a_stopped_run_goes_on_to_the_same_results(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    shutil.copytree(finished, out)
    for name in (LEARNS, DRIVES):
        (out / WORK / name / "done.json").unlink()
    run(RECIPE, out)
    one, other = (json.loads((each / "results.json").read_text()) for each in (finished, out))
    assert one["lifelong"] == other["lifelong"]


def test_the_report_tells_of_it(finished: Path) -> None:
    page = write_report(Run.load(finished), finished).read_text()
    assert "Lifelong learning" in page
    assert "drives through <i>sun</i> and <i>fog</i>" in page
    assert (finished / "pictures" / "lifelong_weather.png").stat().st_size > 10_000
