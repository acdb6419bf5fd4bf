"""An export opened by nuscenes-devkit 1.2, in an environment of its own: it needs numpy below 2."""

import json
import os
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest
from painted_source import CATEGORIES, RETURNS, PaintedSource

from flcav.dataset.formats.export import export
from flcav.dataset.recorder import record
from flcav.dataset.store import Dataset

ASKED = os.environ.get("FLCAV_TEST_NUSCENES") == "1"
SCENES, SPINS = 2, 2

DEVKIT = """
import json, sys
import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud, RadarPointCloud
from nuscenes.utils.geometry_utils import points_in_box, view_points
from nuscenes.utils.splits import get_scenes_of_split

nusc = NuScenes(version="v1.0-flcav", dataroot=sys.argv[1], verbose=False)
nusc.list_scenes()
samples = []
for scene in nusc.scene:
    log = nusc.get("log", scene["log_token"])
    token, spin = scene["first_sample_token"], 0
    while token:
        sample = nusc.get("sample", token)
        path, boxes, _ = nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
        points = LidarPointCloud.from_file(path).points
        rectangles = {}
        for channel in sample["data"]:
            if channel.startswith("CAM"):
                _, shown, intrinsic = nusc.get_sample_data(sample["data"][channel])
                corners = [view_points(box.corners(), intrinsic, normalize=True)[:2] for box in shown]
                rectangles[channel] = [
                    [box.wlh.tolist(), [*xy.min(axis=1).tolist(), *xy.max(axis=1).tolist()]]
                    for box, xy in zip(shown, corners)
                ]
        radar = sample["data"].get("RADAR_FRONT")
        cloud = RadarPointCloud.from_file(nusc.get_sample_data_path(radar)).points if radar else np.zeros((18, 0))
        samples.append(
            {
                "key": f"{log['logfile']}_{spin:04d}_{log['vehicle']}",
                "names": [box.name for box in boxes],
                "sizes": [box.wlh.tolist() for box in boxes],
                "said": [nusc.get("sample_annotation", box.token)["num_lidar_pts"] for box in boxes],
                "inside": [int(points_in_box(box, points[:3], wlh_factor=1.001).sum()) for box in boxes],
                "rectangles": rectangles,
                "radar_m": np.hypot(cloud[0], cloud[1]).tolist(),
            }
        )
        token, spin = sample["next"], spin + 1
splits = {split: get_scenes_of_split(split, nusc) for split in ("flcav_train", "flcav_val")}
print()
print(json.dumps({"samples": samples, "splits": splits, "mask": list(nusc.map[0]["mask"].mask().shape)}))
"""


@pytest.mark.slow
@pytest.mark.skipif(not ASKED, reason="installs 440 MB of nuscenes-devkit and numpy 1; set FLCAV_TEST_NUSCENES=1")
def test_the_devkit_finds_boxes_points_pictures_and_radar(tmp_path: Path):
    record(PaintedSource(SCENES, spins=SPINS), tmp_path / "dataset")
    dataset = Dataset.open(tmp_path / "dataset")
    export(dataset, "nuscenes", tmp_path / "out")
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    installed = subprocess.run([python, "-m", "pip", "install", "-q", "nuscenes-devkit==1.2.0"], capture_output=True)
    if installed.returncode:
        pytest.skip(f"nuscenes-devkit cannot be installed: {installed.stderr.decode()[-200:]}")
    (tmp_path / "read.py").write_text(DEVKIT)
    ran = subprocess.run([python, tmp_path / "read.py", tmp_path / "out"], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    read = json.loads(ran.stdout.splitlines()[-1])
    assert {split: len(scenes) for split, scenes in read["splits"].items()} == {"flcav_train": 2, "flcav_val": 2}
    samples = {sample["key"]: sample for sample in read["samples"]}
    assert len(samples) == len(dataset)
    for frame in (dataset.frame(i) for i in range(len(dataset))):
        sample = samples[frame.key]
        assert len(sample["names"]) == len(CATEGORIES)
        np.testing.assert_allclose(sample["sizes"], frame.annotations.boxes.size[:, [1, 0, 2]])
        assert sample["said"] == sample["inside"] == RETURNS.tolist()
        assert sorted(sample["rectangles"]) == sorted(f"CAM_{name.upper()}" for name in frame.images)
        for name in frame.images:  # a painted actor's rectangle is that of its box's corners
            amodal = frame.annotations.views[name].amodal_box
            found = sample["rectangles"][f"CAM_{name.upper()}"]
            assert len(found) >= (frame.annotations.views[name].pixels > 0).sum()
            for (width, length, height), rectangle in found:
                row = np.abs(frame.annotations.boxes.size - (length, width, height)).sum(axis=1).argmin()
                np.testing.assert_allclose(rectangle, amodal[row], atol=1e-3)
        for echoes in frame.radar.values():
            np.testing.assert_allclose(sample["radar_m"], echoes[:, 0] * np.cos(echoes[:, 2]), rtol=1e-5)
