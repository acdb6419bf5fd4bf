"""Names in other formats' files: none leads out of a folder, and none stands for two recordings or hides a leak."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from painted_source import PaintedSource

from flcav.config import InputError
from flcav.dataset.formats.conversion import export, import_dataset
from flcav.dataset.formats.kitti import KittiFolder
from flcav.dataset.formats.writing import ExportOptions
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate

NAMES = ("../../secret", "/secret", "a/../../../secret", "C:\\secret", "")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("exports")
    record(PaintedSource(2), root / "painted")
    for name in ("kitti", "nuscenes", "opv2v"):
        export(Dataset.open(root / "painted"), name, root / name, ExportOptions(validation=0.5))
    return root


@pytest.fixture
def folder(exported: Path, tmp_path: Path) -> Path:
    """Return a folder with the exports, and a file and a folder beside it that no import may touch."""
    (tmp_path / "secret.jpg").write_bytes(b"\xff\xd8 secret \xff\xd9")
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "file").write_text("kept")
    return shutil.copytree(exported, tmp_path / "folder")


def _edit(path: Path, edit: Callable[[list[dict[str, Any]]], None]) -> None:
    rows = json.loads(path.read_text())
    edit(rows)
    path.write_text(json.dumps(rows))


def _check_refused(name: str, source: Path, sentence: str) -> None:
    """Check that an import is refused, and leaves what is beside it alone."""
    beside = source.parents[1]
    before = sorted(path for path in beside.rglob("*"))
    with pytest.raises(InputError, match=sentence):
        import_dataset(name, source, beside / "out")
    assert sorted(path for path in beside.rglob("*")) == before
    assert (beside / "secret" / "file").read_text() == "kept"


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_of_nuscenes_lies_in_its_folder(name: str, folder: Path):
    def edit(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            if "CAM_FRONT" in row["filename"]:
                row["filename"] = name and f"{name}.jpg"

    _edit(folder / "nuscenes" / "v1.0-flcav" / "sample_data.json", edit)
    _check_refused("nuscenes", folder / "nuscenes", "sample_data.json: .* is no name of a file in ")


def test_a_link_leads_to_a_picture_or_a_point_cloud_alone(folder: Path):
    (folder / "nuscenes" / "samples" / "key").write_text("private")

    def edit(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            if "CAM_FRONT" in row["filename"]:
                row["filename"] = "samples/key"

    _edit(folder / "nuscenes" / "v1.0-flcav" / "sample_data.json", edit)
    _check_refused("nuscenes", folder / "nuscenes", "samples/key: neither a picture nor a point cloud")


@pytest.mark.parametrize("name", [*NAMES, "..", ".", "joined", "recipe.json", "files.parquet", "x" * 200])
def test_a_scene_is_called_as_no_other_folder(name: str, folder: Path):
    def edit(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            row["logfile"] = name if row["logfile"] == "painted-0-000" else row["logfile"]

    _edit(folder / "nuscenes" / "v1.0-flcav" / "log.json", edit)
    _check_refused("nuscenes", folder / "nuscenes", "the name of a scene that a dataset cannot hold")


def test_another_recording_under_way_outlives_an_import_that_is_refused(folder: Path, tmp_path: Path):
    traffic = tmp_path / "out" / ".recording" / "grid-0-000" / "traffic.parquet"
    traffic.parent.mkdir(parents=True)
    traffic.touch()
    with pytest.raises(InputError, match="no split 'holiday'"):
        import_dataset("nuscenes", folder / "nuscenes", tmp_path / "out", split="holiday")
    assert traffic.exists()


def test_a_frame_of_kitti_lies_in_its_folders(folder: Path):
    for part, suffix in (("velodyne", "bin"), ("calib", "txt"), ("image_2", "png"), ("label_2", "txt")):
        path = folder / "kitti" / "training" / part / f"000000.{suffix}"
        shutil.copy(path, folder / path.name)  # where the name leads
    (folder / "kitti" / "ImageSets" / "val.txt").write_text("../../../000000\n")
    _check_refused("kitti", folder / "kitti", r"val.txt: '../../../000000' is no name of a file in ")
    with pytest.raises(InputError, match="is no name of a file in "):
        KittiFolder.open(folder / "kitti", "val")


def test_scenarios_of_one_name_are_both_imported_and_told(folder: Path, tmp_path: Path):
    scenario = folder / "opv2v" / "train" / "painted-0-000"
    shutil.copytree(scenario, folder / "opv2v" / "validate" / "painted-0-000")
    import_dataset("opv2v", folder / "opv2v", tmp_path / "out")
    data = Dataset.open(tmp_path / "out")
    train, val = "train-painted-0-000", "validate-painted-0-000"
    assert data.manifest.recipe["splits"] == {"train": [train], "val": [val, "painted-0-001"]}
    assert len(data.select(scenes=[train])) == len(data.select(scenes=[val])) > 0
    problems = [problem for problem in validate(tmp_path / "out") if "leakage" in problem]
    assert [f"as the scenes {train}, {val}" in problems[0], "point clouds" in problems[1]] == [True, True]


def test_a_scene_of_two_splits_is_refused(folder: Path):
    numbers = (folder / "kitti" / "ImageSets" / "train.txt").read_text().split()
    (folder / "kitti" / "ImageSets" / "train.txt").write_text("\n".join(numbers[1:]))
    listed = folder / "kitti" / "ImageSets" / "val.txt"
    listed.write_text(f"{numbers[0]}\n{listed.read_text()}")
    _check_refused("kitti", folder / "kitti", "the scene 'painted-0-000' is in 'train' and 'val'")
    splits = folder / "nuscenes" / "v1.0-flcav" / "splits.json"
    both = json.loads(splits.read_text())
    splits.write_text(json.dumps(dict.fromkeys(both, both["flcav_val"])))
    _check_refused("nuscenes", folder / "nuscenes", r"splits.json: the scene .* is in 'train' and 'val'")


def test_rows_and_scenes_of_nuscenes_that_are_there_twice(folder: Path):
    tables = folder / "nuscenes" / "v1.0-flcav"
    for table, sentence in (
        ("instance", "instance.json: two rows have the token"),
        ("sample", "sample.json: two rows have the token"),
        ("sample_data", r"sample_data.json: 'samples/.*' is a second one of "),
    ):
        whole = (tables / f"{table}.json").read_text()
        _edit(tables / f"{table}.json", lambda rows: rows.append({**rows[0]}))
        _check_refused("nuscenes", folder / "nuscenes", sentence)
        (tables / f"{table}.json").write_text(whole)
    tables.rename(tables.with_name("v1.0-mini"))

    def rename(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            row["name"] = "one"

    _edit(tables.with_name("v1.0-mini") / "scene.json", rename)
    _check_refused("nuscenes", folder / "nuscenes", "scene.json: two scenes are called 'one'")


def test_frames_of_one_number_in_training_and_testing_keep_their_calibrations(folder: Path, tmp_path: Path):
    kitti = folder / "kitti"
    (kitti / "frames.csv").unlink()
    shutil.rmtree(kitti / "ImageSets")
    shutil.copytree(kitti / "training", kitti / "testing")
    path = kitti / "testing" / "calib" / "000000.txt"
    rows = path.read_text().replace("P2: 2", "P2: 3", 1)
    assert rows != path.read_text()
    path.write_text(rows)
    import_dataset("kitti", kitti, tmp_path / "out")
    data = Dataset.open(tmp_path / "out")
    frames = [
        next(data.frame(i) for i in data.select(scenes=[f"kitti-{part}-000000"])) for part in ("training", "testing")
    ]
    assert frames[0].calibration.intrinsics["image_2"][0, 0] < frames[1].calibration.intrinsics["image_2"][0, 0]
