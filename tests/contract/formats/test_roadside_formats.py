"""DAIR-V2X and TUMTraf, roadside LiDARs: made folders are read as they were made, damaged ones are one sentence."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flcav.cli.main import run
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate
from flcav.perception.agents import POLE, kind_of

POINTS = np.array([(10, 1, -4.2, 0), (20, -3, -4.0, 51), (np.nan, 0, 0, 3), (10.4, 1.2, -4.5, 255)], np.float32)
CAR, TRUCK = (10.0, 1.0, -4.3, 4.4, 1.8, 1.5, 0.7), (20.0, -3.0, -3.6, 9.0, 2.5, 3.2, -2.0)  # x y z l w h yaw
ENDING = "_s110_lidar_ouster"


def write_pcd(path: Path, points: np.ndarray = POINTS) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    rest = f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
    path.write_bytes((header + rest).encode() + points.astype("<f4").tobytes())


def dair_label(kind: str, box: tuple[float, ...], occluded: int) -> dict[str, Any]:
    """Return an object as DAIR-V2X has it, its numbers as text, which some of its releases have."""
    x, y, z, length, width, height, yaw = (str(value) for value in box)
    size, place = {"h": height, "w": width, "l": length}, {"x": x, "y": y, "z": z}
    return {"type": kind, "occluded_state": occluded, "3d_dimensions": size, "3d_location": place, "rotation": yaw}


def tum_label(kind: str, box: tuple[float, ...]) -> dict[str, Any]:
    x, y, z, length, width, height, yaw = box
    turn = Rotation.from_euler("z", yaw).as_quat().tolist()
    return {
        "object_data": {
            "name": "x",
            "type": kind,
            "cuboid": {"name": "box", "val": [x, y, z, *turn, length, width, height]},
        }
    }


def make_dair(root: Path) -> None:
    infos = []
    for number in range(3):
        write_pcd(root / "velodyne" / f"00000{number}.pcd")
        labels = [dair_label("Car", CAR, 0), dair_label("Truck", TRUCK, 2), dair_label("Trafficcone", CAR, 1)]
        path = root / "label" / "virtuallidar" / f"00000{number}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(labels))
        about = {"pointcloud_path": f"velodyne/00000{number}.pcd", "intersection_loc": "yard"}
        infos.append(about | {"sequence_id": "0007", "pointcloud_timestamp": f"{1626155123000000 + 100000 * number}"})
    (root / "data_info.json").write_text(json.dumps(infos[::-1]))


def make_tumtraf(root: Path) -> None:
    for lidar in ("north", "south"):
        for number in range(3):
            stem = f"164666731{number}_100000000{ENDING}_{lidar}"
            write_pcd(root / "point_clouds" / f"ouster_{lidar}" / f"{stem}.pcd", POINTS * (1, 1, 1, 10))
            objects = {"a-1": tum_label("CAR", CAR), "b-2": tum_label("TRUCK", TRUCK)}
            frame = {"frame_properties": {"timestamp": 1.0}, "objects": objects}
            path = root / "labels_point_clouds" / f"ouster_{lidar}" / f"{stem}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"openlabel": {"metadata": {}, "frames": {str(number): frame}}}))


MADE: dict[str, Callable[[Path], None]] = {"dair-v2x": make_dair, "tumtraf": make_tumtraf}


@pytest.fixture(params=MADE)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def folder(name: str, tmp_path: Path) -> Path:
    root = tmp_path / "r02_s01"
    MADE[name](root)
    return root


def test_sweeps_and_boxes_are_read_as_they_were_made(name: str, folder: Path, tmp_path: Path) -> None:
    import_dataset(name, folder, tmp_path / "out")
    assert validate(tmp_path / "out") == []
    data = Dataset.open(tmp_path / "out")
    poles = {"dair-v2x": ["pole1"], "tumtraf": ["pole0", "pole1"]}[name]
    step = {"dair-v2x": 0.1, "tumtraf": 1.0}[name]
    assert {key.scene for key in data.keys} == {"dair-0007" if name == "dair-v2x" else "r02_s01"}
    assert sorted((key.index, key.agent, round(key.time_s, 3)) for key in data.keys) == [
        (number, pole, round(number * step, 3)) for number in range(3) for pole in poles
    ]
    frame = data.frame(0)
    expected = POINTS[np.isfinite(POINTS).all(axis=1)] * (1, 1, 1, 1 / 255 if name == "dair-v2x" else 10 / 65535)
    np.testing.assert_allclose(frame.lidar["lidar"], expected, atol=1e-6)
    found = frame.annotations
    assert found.boxes.label[:2].tolist() == ["car", "truck"]
    np.testing.assert_allclose(found.boxes.array()[:2], np.array([CAR, TRUCK]), atol=1e-9)
    assert found.returns.tolist()[0] == 2
    assert found.track.tolist()[:2] == (["000000-0", "000000-1"] if name == "dair-v2x" else ["a-1", "b-2"])
    if name == "dair-v2x":
        assert found.boxes.label[2] == "Trafficcone"
        np.testing.assert_allclose(found.occlusion, [0, 0.75, 0.3])
    assert {kind_of(key.agent) for key in data.keys} == {POLE}


def test_sweeps_without_labels_are_left_out_and_counted(name: str, folder: Path, tmp_path: Path) -> None:
    labels = sorted(folder.rglob("label*/*/*.json"))
    labels[0].unlink()
    notes = import_dataset(name, folder, tmp_path / "out")
    assert notes == (f"left out 1 sweep without labels: {labels[0].stem}.pcd",)
    assert len(Dataset.open(tmp_path / "out").keys) == len(labels) - 1


def test_a_folder_of_sequences_is_as_many_scenes(tmp_path: Path) -> None:
    for scene in ("s01", "s02"):
        make_tumtraf(tmp_path / "all" / scene)
    import_dataset("tumtraf", tmp_path / "all", tmp_path / "out")
    assert {key.scene for key in Dataset.open(tmp_path / "out").keys} == {"s01", "s02"}


def test_sweeps_that_are_in_no_sequence_are_scenes_of_their_own(tmp_path: Path) -> None:
    make_dair(tmp_path / "in")
    (tmp_path / "in" / "data_info.json").unlink()
    import_dataset("dair-v2x", tmp_path / "in", tmp_path / "out")
    keys = Dataset.open(tmp_path / "out").keys
    assert [(key.scene, key.agent, key.time_s) for key in keys] == [(f"dair-00000{i}", "pole0", 0.0) for i in range(3)]


def replaced(old: str, new: str) -> Callable[[Path], int]:
    return lambda path: path.write_bytes(path.read_bytes().replace(old.encode(), new.encode()))


def written(text: str) -> Callable[[Path], int]:
    return lambda path: path.write_text(text)


def cut(path: Path) -> int:
    return path.write_bytes(path.read_bytes()[:-7])


DAMAGE: dict[str, tuple[str, Callable[[Path], int], str]] = {
    "no cuboid": ("*/*/*.json", replaced('"type"', '"kind"'), "object 1 is no"),
    "not JSON": ("*/*/*.json", written("{"), "not JSON"),
    "a list of numbers": ("*/*/*.json", written("[1]"), "object 1 is no"),
    "truncated": ("**/*.pcd", cut, "truncated"),
    "other fields": ("**/*.pcd", replaced("intensity", "ring"), "not a sweep"),
    "a size below 0": ("*/*/*.json", replaced("1.5", "-1.5"), "not positive"),
    "not finite": ("*/*/*.json", replaced("10.0", "1e999"), "is not finite"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_one_sentence(
    name: str, folder: Path, damage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pattern, change, told = DAMAGE[damage]
    path = sorted(folder.glob(pattern))[-1]
    change(path)
    with pytest.raises(SystemExit) as stopped:
        run(["import", name, str(folder), "--out", str(tmp_path / "out")])
    assert stopped.value.code == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"flcav: {path}: ")
    assert told in said
    assert "\n" not in said


def test_a_table_of_another_form_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_dair(tmp_path / "in")
    (tmp_path / "in" / "data_info.json").write_text('[{"path": 1}]')
    with pytest.raises(SystemExit):
        run(["import", "dair-v2x", str(tmp_path / "in"), "--out", str(tmp_path / "out")])
    assert "data_info.json: not the list of sweeps of DAIR-V2X" in capsys.readouterr().err
