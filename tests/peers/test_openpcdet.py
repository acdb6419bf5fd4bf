"""KITTI's layout, by OpenPCDet's own dataset, augmentation and evaluation."""

import csv
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Peer
from recorded import in_lidar, points_in

from flcav.dataset.formats.conversion import export
from flcav.dataset.formats.kitti.write import CLASSES
from flcav.dataset.formats.writing import ExportOptions
from flcav.dataset.store import Dataset
from flcav.geometry import wrap_angle

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
OPENPCDET = REAL / "peers" / "OpenPCDet"
SCORED = ("Car", "Pedestrian", "Cyclist")
pytestmark = pytest.mark.skipif(
    not OPENPCDET.is_dir(), reason=f"OpenPCDet's Python is not at {OPENPCDET}; set FLCAV_REAL_DATA"
)


def _keys(out: Path) -> dict[str, str]:
    with (out / "frames.csv").open(encoding="utf-8") as file:
        return {row["number"]: row["frame"] for row in csv.DictReader(file)}


def test_its_tables_training_and_evaluation_find_what_was_recorded(
    streets: Dataset, peer: Callable[[str], Peer], tmp_path: Path
):
    """Detections are the recorded boxes, by the recorded calibration: they score full marks; reversed, none in AOS."""
    out = tmp_path / "out"
    export(streets, "kitti", out, ExportOptions(validation=0.5))
    keys, detections = _keys(out), {}
    for number, key in keys.items():
        frame = streets.frame(streets.number(key))
        found = detections[number] = {name: [] for name in SCORED}
        views = next(iter(frame.annotations.views.values()))
        rows = in_lidar(frame).array()
        for i in np.flatnonzero((points_in(frame) > 0) & ~np.isnan(views.amodal_box[:, 0])):
            if (name := CLASSES[str(frame.annotations.boxes.label[i])]) in SCORED:
                found[name].append(rows[i].tolist())
    train = (out / "ImageSets" / "train.txt").read_text().split()
    classes = [name for name in SCORED if any(detections[number][name] for number in train)]  # it needs one to paste
    detections = {number: {name: found[name] for name in classes} for number, found in detections.items()}
    (tmp_path / "detections.json").write_text(json.dumps(detections))
    read = peer("openpcdet").read(OPENPCDET, out, tmp_path / "detections.json", NUMBA_ENABLE_CUDASIM="1")

    labels, counted = 0, 0
    for number, key in keys.items():
        frame, theirs = streets.frame(streets.number(key)), read["frames"][number]
        boxes, truth, points = np.array(theirs["boxes"]).reshape(-1, 7), in_lidar(frame), points_in(frame)
        away = np.abs(boxes[:, None, :3] - truth.center[None]).max(axis=2)
        row = away.argmin(axis=1)
        assert away.min(axis=1, initial=0).max(initial=0) < 0.01  # it lifts boxes along the LiDAR's axis
        np.testing.assert_allclose(boxes[:, 3:6], truth.size[row], atol=1e-4)
        np.testing.assert_allclose(wrap_angle(boxes[:, 6] - truth.yaw[row]), 0, atol=2e-4)
        whole = np.array(theirs["truncated"]) == 0  # it counts within the image alone
        np.testing.assert_allclose(np.array(theirs["points"])[whole], points[row][whole], atol=2)
        labels, counted = labels + len(boxes), counted + int(whole.sum())
    assert labels > counted > 50

    assert len(read["boxes"]) == len(train)
    assert read["voxels"][1:] == [5, 4]
    for name in classes:
        found, turned = read["as they are"], read["reversed"]
        assert turned[f"{name}_3d/hard_R40"] == found[f"{name}_3d/hard_R40"]
        assert turned[f"{name}_aos/hard_R40"] < 0.01 < found[f"{name}_aos/hard_R40"]
        assert found[f"{name}_aos/hard_R40"] == pytest.approx(found[f"{name}_image/hard_R40"], abs=0.01)
    for measure, least in {"3d": 99.9, "bev": 99.9, "image": 95, "aos": 95}.items():  # an image cuts boxes off
        assert read["as they are"][f"Car_{measure}/hard_R40"] > least


def test_it_reads_frames_without_labels(deserted: Dataset, peer: Callable[[str], Peer], tmp_path: Path):
    out = tmp_path / "out"
    export(deserted, "kitti", out, ExportOptions(validation=0.5))
    lines = {number: (out / "training" / "label_2" / f"{number}.txt").read_text().splitlines() for number in _keys(out)}
    frames = peer("openpcdet").read(OPENPCDET, out)["frames"]
    assert frames.keys() == lines.keys()
    assert any(frame["names"] == ["DontCare"] and not frame["boxes"] for frame in frames.values())
    for number, frame in frames.items():
        assert frame["names"] == [line.split()[0] for line in lines[number]]
