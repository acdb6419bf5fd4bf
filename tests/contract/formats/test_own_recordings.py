"""The reader of the tutorial on one's own recordings, on made files in the layout of Astyx HiRes2019."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from kitti_folders import cast
from scipy.spatial.transform import Rotation

from flcav.cli.main import run
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, pose, transform_points
from flcav.runs.recipe import load_run_recipe

ROOT = Path(__file__).parents[3]
READER, PAGE = "10_your_own_recordings", ROOT / "docs" / "own-recordings.md"
RADAR_FROM_LIDAR = pose(-0.8, 0.1, 0.9, 0.02, 0.03, -0.01)
SCENES, FRAMES, HEIGHT_M = 4, 2, 1.4
CAR = {"classname": "Car", "center3d": [14.0, 0.0, -0.65], "dimension3d": [4.0, 4.0, 1.5]}
LEANING = Rotation.from_euler("ZYX", (0.3, 0.1, 0.0)).as_quat()[[3, 0, 1, 2]]
OTHERS = [  # class, quaternion w, x, y, z
    ("Towed Object", [1.0, 0.0, 0.0, 0.0]),
    ("Person", LEANING.tolist()),
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write drives past a car, with a person and a trailer; the working directory is that of the examples."""
    for part in ("lidar_vlp16", "calibration", "groundtruth_obj3d"):
        (tmp_path / "astyx" / part).mkdir(parents=True)
    for number in range(SCENES * FRAMES):
        write_frame(tmp_path / "astyx", number, 40.0 * (number // FRAMES) + number)
    monkeypatch.chdir(ROOT / "examples")
    monkeypatch.setattr("sys.path", [path for path in sys.path if path])
    return tmp_path / "astyx"


def write_frame(folder: Path, number: int, time_s: float) -> None:
    name, cloud = f"{number:06d}", cast(16, HEIGHT_M, 0, 0, number)[::2]
    cloud[:, :3] = transform_points(inverse(RADAR_FROM_LIDAR), cloud[:, :3])
    rows = [
        f"{x:.4f} {y:.4f} {z:.4f} {100 * i:.0f} 7 {1e6 * time_s + row:.0f}" for row, (x, y, z, i) in enumerate(cloud)
    ]
    (folder / "lidar_vlp16" / f"{name}.txt").write_text("\n".join(["X Y Z Reflectivity LaserID Timestamp", *rows]))
    sensors = [("radar_6455", np.eye(4)), ("lidar_vlp16", RADAR_FROM_LIDAR)]
    calibrated = [{"sensor_uid": uid, "calib_data": {"T_to_ref_COS": at.tolist()}} for uid, at in sensors]
    (folder / "calibration" / f"{name}.json").write_text(json.dumps({"sensors": calibrated}))
    objects = [CAR | {"orientation_quat": [0.0, 0.0, 0.0, 1.0]}]
    for row, (label, quaternion) in enumerate(OTHERS):
        other = {"classname": label, "center3d": [9.0, 8.6 - 17 * row, -0.4], "dimension3d": [2.0, 1.0, 2.0]}
        objects.append(other | {"orientation_quat": quaternion})
    (folder / "groundtruth_obj3d" / f"{name}.json").write_text(json.dumps({"objects": objects}))


def ended(*command: object) -> int:
    with pytest.raises(SystemExit) as end:
        run([str(word) for word in command])
    return int(end.value.code or 0)


def imported(folder: Path, split: str) -> Path:
    out = folder.parent / split
    assert ended("import", f"{READER}:IMPORT", folder, "--split", split, "--out", out) == 0
    return out


def test_points_boxes_and_scenes_are_read(folder: Path, capsys: pytest.CaptureFixture[str]):
    data, held = Dataset.open(imported(folder, "train")), Dataset.open(imported(folder, "val"))
    said = capsys.readouterr().out
    assert "the ground of 8 sweeps lies 1.40 m (+- 0.0" in said
    assert ended("validate", data.folder, held.folder) == 0
    assert (len(data), len(held), data.manifest.recipe["beams"]) == (6, 2, 16)
    assert dict.fromkeys(key.agent for key in data.keys) == dict.fromkeys(("car0", "car1", "car2"))
    frame = data.frame(1)
    assert frame.time_s == pytest.approx(1.0)
    points, expected = frame.lidar["lidar"], cast(16, HEIGHT_M, 0, 0, 1)[::2]
    np.testing.assert_allclose(points[:, :3], expected[:, :3], atol=1e-3)
    np.testing.assert_allclose(points[:, 3], 30 / 255, atol=1e-3)
    boxes = frame.annotations.boxes
    assert boxes.label.tolist() == ["car", "towed_object", "pedestrian"]
    np.testing.assert_allclose(boxes.center[0], (14, 0, HEIGHT_M - 0.65), atol=0.02)
    np.testing.assert_allclose(np.cos(boxes.yaw), (-1, 1, np.cos(0.3)), atol=1e-9)
    assert boxes.tilt is not None
    np.testing.assert_allclose(np.abs(boxes.tilt[2]), (0.1, 0), atol=1e-9)
    assert frame.annotations.returns[0] > 20


def test_the_recipe_of_the_page_is_one(tmp_path: Path):
    (text,) = re.findall(r"^```yaml\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    (tmp_path / "own.yaml").write_text(text, encoding="utf-8")
    assert load_run_recipe(tmp_path / "own.yaml").regions["drive"].role == "federate"


@pytest.mark.slow
def test_a_detector_is_trained_and_evaluated_on_them(folder: Path, capsys: pytest.CaptureFixture[str]):
    data, held, out = imported(folder, "train"), imported(folder, "val"), folder.parent / "own"
    assert ended("train", "objects", "--data", data, "--network", "tiny", "--epochs", 1, "--out", out) == 0
    weights = out / "weights.safetensors"
    assert ended("evaluate", "objects", "--data", held, "--weights", weights) == 0
    assert "2 vehicle frames" in capsys.readouterr().out
