"""COCO's layout, by COCO's own tools: reading, masks, evaluation."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Peer

from flcav.dataset.formats.conversion import export
from flcav.dataset.rectangles import CLASSES
from flcav.dataset.store import Dataset


@pytest.mark.parametrize("labels", CLASSES)
def test_it_reads_masks_and_scores(labels: str, streets: Dataset, peer: Callable[[str], Peer], tmp_path: Path):
    """The labels as detections score full marks; a mask has the area and the outline of its actor's pixels."""
    export(streets, "coco", tmp_path / "out")
    read = peer("pycocotools").read(tmp_path / "out", labels)
    rows = [row for split in read.values() for row in split["rows"]]
    assert len(rows) > 10
    for split in read.values():
        assert min(split["ap"].values()) > 0.999
    frames = {f"{frame.key}_{camera}": (frame, camera) for frame in _frames(streets) for camera in frame.images}
    for row in rows if labels == "signs" else []:
        assert row["mask_bbox"] == row["bbox"]
        assert row["area"] == row["sum"] >= row["said"]
    for row in rows if labels == "actors" else []:
        frame, camera = frames[row["image"]]
        number = 1 + frame.annotations.track.tolist().index(row["track"])
        v, u = np.nonzero(frame.images[camera].instance == number)
        assert row["area"] == row["sum"] == row["said"] == len(u)
        outline = [u.min(), v.min(), u.max() + 1 - u.min(), v.max() + 1 - v.min()]
        assert row["mask_bbox"] == row["bbox"] == outline


def _frames(dataset: Dataset):
    return (dataset.frame(i) for i in range(len(dataset)))
