"""Every command that takes a recording takes an imported dataset: from a folder of OPV2V to the poles it needs."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from painted_source import PaintedSource
from PIL import Image

from flcav.cli.main import run
from flcav.dataset.formats.conversion import export
from flcav.dataset.formats.writing import ExportOptions
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.perception.errors import load_errors

SCENES = 2


@pytest.fixture
def flcav(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command; return what it prints, or, where it ends with 2, its sentence."""

    def call(*arguments: object) -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            run([str(argument) for argument in arguments])
        told = capsys.readouterr()
        assert ended.value.code in (None, 0, 2), told.err
        return told.err if ended.value.code else told.out

    return call


@pytest.mark.slow
def test_an_imported_dataset_goes_through_all_commands(tmp_path: Path, flcav: Callable[..., str]) -> None:
    record(PaintedSource(SCENES, spins=1, tilted=(1,)), tmp_path / "painted")
    painted = Dataset.open(tmp_path / "painted")
    export(painted, "opv2v", tmp_path / "opv2v", ExportOptions(validation=0.0))

    data, weights = tmp_path / "data", tmp_path / "network" / "weights.safetensors"
    assert "4 frames" in flcav("import", "opv2v", tmp_path / "opv2v", "--out", data)
    learned = flcav("train", "objects", "--data", data, "--out", weights.parent, "--network", "tiny", "--epochs", 1)
    assert learned.startswith(f"{data}: 2 vehicle and 2 pole frames\n")

    options = ("--weights", weights, "--agents", "vehicles")
    said: dict[str, Any] = json.loads(flcav("evaluate", "objects", "--data", data, "--around", "--json", *options))
    assert (said["frames"], said["agents"]) == (SCENES, ["cav0"])
    assert said["scores"][0]["targets"] > 0
    found = json.loads(flcav("infer", "objects", data, "--around", "--json", *options))
    assert len(found["inputs"]) == SCENES

    table, poles = tmp_path / "errors.parquet", tmp_path / "poles.csv"
    flcav("errors", "objects", "--data", data, "--out", table, *options)
    errors = load_errors(table)
    assert errors
    poles.write_text(f"id,x,y,z\nmine,{errors[0].x},{errors[0].y},{errors[0].z + 6}\nfar,900,900,6\n")
    place = ("place", "--errors", table, "--poles", poles, "--range", 10, "--count", 1)
    assert [each["pole"] for each in json.loads(flcav(*place, "--data", data, "--json"))["chosen"]] == ["mine"]
    for refused in ((*place, "--map", tmp_path / "map.png"), (*place, "--data", data, "--line-of-sight")):
        assert "needs --town, or --data whose town is known" in flcav(*refused)


@pytest.mark.slow
def test_a_folder_of_kitti_is_evaluated_as_the_benchmark_does(tmp_path: Path, flcav: Callable[..., str]) -> None:
    record(PaintedSource(SCENES, spins=1), tmp_path / "painted")
    export(Dataset.open(tmp_path / "painted"), "kitti", tmp_path / "kitti", ExportOptions(validation=0.5))
    said = json.loads(flcav("evaluate", "objects", "--data", tmp_path / "kitti", "--json"))
    assert (said["frames"], said["split"]) == (1, "val")
    assert said["targets"]["Car"] == {"easy": 0, "moderate": 1, "hard": 1}
    assert [row["class"] for row in said["benchmark"]] == [name for name in said["targets"] for _ in range(5)]
    assert [row["kind"] for row in said["benchmark"]] == ["image", "bev", "3d", "bev", "3d"] * 3
    assert [row["iou"] for row in said["benchmark"]] == [0.7, 0.7, 0.7, 0.5, 0.5] + 2 * [0.5, 0.5, 0.5, 0.25, 0.25]
    assert {(row["easy"] is None, row["hard"] is None) for row in said["benchmark"][:3]} == {(True, False)}
    assert (said["bare"], said["threshold"]) == (0, 0.3)
    told = flcav("evaluate", "objects", "--data", tmp_path / "kitti")
    assert f"Car        {said['false_positives']['Car']:.2f} false positives a frame" in told
    pictures = [*(tmp_path / "kitti" / "training" / "image_2").iterdir()]
    with Image.open(pictures[0]) as picture:
        width, height = picture.size
    for path in pictures:
        path.unlink()
    bare = json.loads(flcav("evaluate", "objects", "--data", tmp_path / "kitti", "--json"))
    assert (bare["bare"], bare["bare_px"]) == (1, [f"{width} x {height}"])
    for key in ("targets", "split"):
        assert bare[key] == said[key]
    assert f"1 of them without an image, taken as {width} x {height} pixels" in flcav(  # by the camera's calibration
        "evaluate", "objects", "--data", tmp_path / "kitti"
    )
