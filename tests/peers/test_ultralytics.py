"""YOLO's layout, by Ultralytics: its check of a dataset, its reading of labels, an epoch of training, a test."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import yaml
from conftest import PEERS, Peer

from flcav.dataset.formats.conversion import export
from flcav.dataset.formats.writing import ExportOptions
from flcav.dataset.rectangles import CLASSES, select_rectangles
from flcav.dataset.store import Dataset

# it fetches nothing, and leaves no settings behind
ALONE = {"YOLO_OFFLINE": "true", "YOLO_AUTOINSTALL": "false", "YOLO_CONFIG_DIR": str(PEERS / "ultralytics")}


def _expected(dataset: Dataset, labels: str) -> dict[str, list[list[float]]]:
    rows = {}
    for frame in (dataset.frame(i) for i in range(len(dataset))):
        for camera, picture in frame.images.items():
            height, width = picture.rgb.shape[:2]
            found = select_rectangles(frame, camera, labels, 1)
            left, top, right, bottom = (found.box / (width, height, width, height)).T
            boxes = np.stack((found.label, (left + right) / 2, (top + bottom) / 2, right - left, bottom - top), axis=1)
            rows[f"{frame.key}_{camera}"] = sorted(boxes.tolist())
    return rows


@pytest.mark.parametrize("labels", CLASSES)
def test_it_checks_reads_and_trains(
    labels: Literal["signs", "actors"], streets: Dataset, peer: Callable[[str], Peer], tmp_path: Path
):
    out = tmp_path / "out"
    export(streets, "yolo", out, ExportOptions(labels=labels))
    read = peer("ultralytics").read(out, tmp_path / "runs", **ALONE)
    assert list(read["names"].values()) == list(CLASSES[labels])
    found = {**read["labels"]["train"], **read["labels"]["val"]}
    expected = _expected(streets, labels)
    assert found.keys() == expected.keys()
    assert sum(map(len, expected.values())) > 10
    for name, rows in expected.items():
        np.testing.assert_allclose(np.array(sorted(found[name])).reshape(-1, 5), np.reshape(rows, (-1, 5)), atol=2e-6)
    assert 0 <= read["measured"]["metrics/mAP50(B)"] <= 1
    assert read["weights"] > 10**6


@pytest.mark.parametrize("split", ["val", "test"])
def test_it_tests_on_what_was_recorded_for_that(
    split: str, streets: Dataset, peer: Callable[[str], Peer], tmp_path: Path
):
    """The `data.yaml` of such a dataset names folders to train and validate, though nothing is in them."""
    recorded_for = Dataset.open(streets.folder)
    recorded_for.manifest.recipe = {**recorded_for.manifest.recipe, "split": split}
    export(recorded_for, "yolo", tmp_path / "out")
    assert {"train", "val", split} <= yaml.safe_load((tmp_path / "out" / "data.yaml").read_text()).keys()
    read = peer("ultralytics").read(tmp_path / "out", tmp_path / "runs", split, **ALONE)
    assert read["labels"][split].keys() == _expected(streets, "signs").keys()
