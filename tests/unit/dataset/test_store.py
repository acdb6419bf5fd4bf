import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from toy_source import ToySource

from flcav.config import InputError
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate
from flcav.storage.files import sha256
from flcav.world.map.town import load_town


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    record(ToySource(), tmp_path / "data")
    return tmp_path / "data"


def test_frames_come_back_bit_for_bit(folder: Path):
    dataset = Dataset.open(folder)
    source = ToySource()
    recorded = [frame for scene in source.scenes() for frame in source.frames(scene)]
    assert len(dataset) == len(recorded) == 12
    for i, frame in enumerate(recorded):
        stored, key = dataset.frame(i), dataset.keys[i]
        assert (key.scene, key.index, key.agent, key.time_s) == (frame.scene, frame.index, frame.agent, frame.time_s)
        assert stored.key == frame.key
        assert dataset.number(frame.key) == i
        np.testing.assert_array_equal(stored.world_from_agent, frame.world_from_agent)
        np.testing.assert_array_equal(stored.agent_from_sensor["lidar"], frame.agent_from_sensor["lidar"])
        np.testing.assert_array_equal(stored.lidar["lidar"], frame.lidar["lidar"])
        np.testing.assert_array_equal(stored.annotations.boxes.array(), frame.annotations.boxes.array())
        np.testing.assert_array_equal(stored.annotations.velocity, frame.annotations.velocity)
        np.testing.assert_array_equal(stored.annotations.occlusion, frame.annotations.occlusion)
        assert stored.annotations.track.tolist() == frame.annotations.track.tolist()
        assert stored.annotations.boxes.label.tolist() == frame.annotations.boxes.label.tolist()
        assert stored.annotations.returns.tolist() == frame.annotations.returns.tolist()


def test_select_filters_by_agent_scene_and_spin(folder: Path):
    dataset = Dataset.open(folder)
    assert dataset.select() == list(range(12))
    assert dataset.select(agents=["pole3"], scenes=["toy-0-001"], spins=[0, 2]) == [7, 11]
    assert dataset.select(agents=["cav9"]) == []


def test_a_folder_without_manifest_is_unfinished(folder: Path):
    (folder / "manifest.json").unlink()
    with pytest.raises(InputError, match=r"manifest\.json: missing"):
        Dataset.open(folder)


def test_no_folder(tmp_path: Path):
    with pytest.raises(InputError, match="no such dataset folder"):
        Dataset.open(tmp_path / "nothing")


@pytest.mark.parametrize("content", ["{", "[]", '{"format": 1}'])
def test_a_manifest_that_is_none(folder: Path, content: str):
    (folder / "manifest.json").write_text(content)
    with pytest.raises(InputError, match=r"manifest\.json"):
        Dataset.open(folder)


def test_a_manifest_of_another_format(folder: Path):
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"format": 99}))
    with pytest.raises(InputError, match="format 99"):
        Dataset.open(folder)


@pytest.mark.parametrize("kept", [0, 15, 16, -1])
def test_a_truncated_point_cloud_is_named(folder: Path, kept: int):
    path = folder / "lidar" / "toy-0-000_0000_cav0.bin"
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"toy-0-000_0000_cav0\.bin: \d+ bytes where"):
        Dataset.open(folder).frame(0)


def test_a_missing_point_cloud_is_named(folder: Path):
    (folder / "lidar" / "toy-0-000_0000_cav0.bin").unlink()
    with pytest.raises(InputError, match=r"toy-0-000_0000_cav0\.bin: missing"):
        Dataset.open(folder).frame(0)


@pytest.mark.parametrize(
    "name", ["frames.parquet", "poses.parquet", "annotations.parquet", "views.parquet", "calibration.json"]
)
def test_an_unreadable_table_is_named(folder: Path, name: str):
    path = folder / name
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match=name):
        Dataset.open(folder)
    path.unlink()
    with pytest.raises(InputError, match=name):
        Dataset.open(folder)


def test_tables_of_two_datasets_do_not_mix(folder: Path, tmp_path: Path):
    record(ToySource(seed=1), tmp_path / "other")
    for name in ("poses.parquet", "annotations.parquet"):
        kept = (folder / name).read_bytes()
        (folder / name).write_bytes((tmp_path / "other" / name).read_bytes())
        with pytest.raises(InputError, match=f"{name}: its rows are not those of the frames"):
            Dataset.open(folder)
        (folder / name).write_bytes(kept)


def test_an_empty_dataset(tmp_path: Path):
    record(ToySource(spins=0), tmp_path / "data")
    with pytest.raises(InputError, match="empty"):
        Dataset.open(tmp_path / "data")


def test_a_listed_file_lies_in_the_dataset(folder: Path, tmp_path: Path):
    secret = tmp_path / "secret"
    secret.write_text("private")
    manifest = json.loads((folder / "manifest.json").read_text())
    for name in ("../secret", str(secret), ""):
        manifest["tables"][name] = {"bytes": 7, "sha256": sha256(secret)}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    problems = [problem for problem in validate(folder) if problem.endswith("no name of a file within the dataset")]
    assert problems == [
        f"{folder / name}: no name of a file within the dataset" for name in ("../secret", str(secret), "")
    ]


def test_a_town_is_in_the_dataset_or_of_the_package(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    elsewhere = shutil.copytree(Path(load_town("grid").net).parent, tmp_path / "elsewhere")
    manifest = json.loads((folder / "manifest.json").read_text())
    monkeypatch.chdir(tmp_path)
    for name, known in (("grid", True), ("elsewhere", False), ("../../elsewhere", False), (str(elsewhere), False)):
        manifest["recipe"]["town"] = name
        (folder / "manifest.json").write_text(json.dumps(manifest))
        assert (Dataset.open(folder).town() is not None) == known
    shutil.copytree(elsewhere, folder / "town" / "elsewhere")
    manifest["recipe"]["town"] = "elsewhere"
    (folder / "manifest.json").write_text(json.dumps(manifest))
    town = Dataset.open(folder).town()
    assert town is not None
    assert town.net == folder / "town" / "elsewhere" / "town.net.xml"
