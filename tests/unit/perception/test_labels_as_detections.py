"""Labels that are fed back as detections: the full AP for a class with objects, and none for one without any."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flcav.dataset.formats.kitti import KittiFolder
from flcav.geometry import Boxes
from flcav.perception.kitti_benchmark import truth_of
from flcav.perception.objects.evaluate import ObjectsEvaluation, count_objects, score_detections

DATA = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4] / "shared" / "data"))
CLASSES = ("Car", "Pedestrian", "Cyclist")


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no KITTI frame at {DATA}; set FLCAV_REAL_DATA")
def test_they_have_the_full_precision_and_absent_classes_none() -> None:
    truths = [truth_of(KittiFolder.open(DATA / "kitti_frame", pictures=False).frame(0))]
    detections: list[Boxes] = [replace(each.targets, score=np.ones(len(each.targets))) for each in truths]
    scores = score_detections(detections, truths, CLASSES)
    known = {label for each in truths for label in each.targets.label.tolist()}
    assert known == {"Car"}
    assert {(row.label, row.ap) for row in scores} == {("Car", 1.0), ("Pedestrian", None), ("Cyclist", None)}
    counts = count_objects(detections, truths, CLASSES)
    found = ObjectsEvaluation(frames=1, scenes=1, scores=scores, counts=counts, slices=(), trust=())
    lines = [line for line in found.lines() if line.startswith(("Pedestrian", "Cyclist"))]
    assert sum("nothing to find  (objects: 0, " in line for line in lines) == 8
    assert not any("AP 0" in line for line in lines)
