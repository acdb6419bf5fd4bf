"""Recorded datasets in a run whose rig is not that of the networks' training."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flcav.cli.steps import live_steps
from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.runs import edge_stage, running
from flcav.runs.edge_stage import federate_regions
from flcav.runs.engine import Notify
from flcav.runs.recipe import RunRecipe
from flcav.runs.rigs import RIG, compare_rigs, tell_rigs
from flcav.runs.running import run, run_several
from flcav.runs.stages.outline import Outline
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

RECORDING = {"town": "suburb", "warmup_s": 5.0, "spins_per_scene": 1, "weather": "clear"}
LIDAR = {"mount": {"z": 2.4, "yaw_deg": 90.0}, "settings": {"channels": 16, "range_m": 40.0}}
TOLD = (
    "street, objects: unlike in the network's training the LiDAR has 16 beams, not 64 and reaches 40 m, not 120 m and "
    "is 2.40 m above the ground, not 1.8 m (corrected) and is turned by 90 degrees (corrected)"
)


def outline_of(data: Path, rig: str = "kitti_lidar") -> Outline:
    own: dict[str, Any] = {"history": "objects", "labels": "own-detections", "recording": {"vehicle_rig": rig}}
    recipe = {
        "tasks": {"objects": own, "weather": {"history": "weather"}},
        "regions": {
            "suburb": {"role": "pretrain"},
            "grid": {"role": "federate"},
            "street": {"role": "unseen", "data": {"validation": str(data), "test": str(data)}},
        },
        "budgets_mb": {"wireless": 1, "wireline": 1},
    }
    return Outline(RunRecipe.model_validate(recipe), Path())


@pytest.fixture(scope="module")
def otherwise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "street"
    record(EmbeddedSource(parse_config(Recipe, RECORDING | {"vehicle_rig": {"lidars": {"top": LIDAR}}}, "recipe")), out)
    return out


def test_another_rig_is_told_once_for_each_region_and_task(otherwise: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outline = outline_of(otherwise)
    assert compare_rigs(outline) == (TOLD,)  # of both splits alike; weather knows no rig
    with live_steps("run") as notify:
        tell_rigs([outline, outline], notify)
    assert capsys.readouterr().err.replace("\n", " ").split() == ["run:", *TOLD.split()]


def begin_run(recipe: RunRecipe, out: Path, notify: Notify) -> None:
    run(recipe, out, notify=notify)


def begin_several(recipe: RunRecipe, out: Path, notify: Notify) -> None:
    run_several({"one": recipe, "other": recipe.model_copy(update={"seed": 2})}, out, notify=notify)


def begin_federation(recipe: RunRecipe, out: Path, notify: Notify) -> None:
    federate_regions(recipe, out, notify=notify)


@pytest.mark.parametrize("begin", [begin_run, begin_several, begin_federation])
def test_runs_and_federations_tell_it_before_their_steps(
    otherwise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begin: Callable[[RunRecipe, Path, Notify], None]
) -> None:
    class Begun(Exception):
        pass

    def begun(*_: object, **__: object) -> None:
        raise Begun

    for place, name in ((running, "run_steps"), (running, "run_side_by_side"), (edge_stage, "run_steps")):
        monkeypatch.setattr(place, name, begun)
    told: list[tuple[str, str]] = []
    with pytest.raises(Begun):
        begin(outline_of(otherwise).recipe, tmp_path, lambda step, done, total, note: told.append((step, note)))
    assert told == [(RIG, TOLD)]


def test_the_rig_of_the_training_is_not_told(tmp_path: Path) -> None:
    rig = {"lidars": {"velodyne": {"mount": {"z": 1.73}, "settings": {"beams": "hdl64e"}}}}
    record(EmbeddedSource(parse_config(Recipe, RECORDING | {"vehicle_rig": rig}, "recipe")), tmp_path / "same")
    assert compare_rigs(outline_of(tmp_path / "same")) == ()
