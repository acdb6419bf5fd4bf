"""Labels of the trained road detector, graded against those of an ideal one."""

import numpy as np

from flcav.geometry import Boxes
from flcav.reproductions.road_detector.run import RoadDetectorResult, RoadLabels, detector_tables, grade_labels
from flcav.runs.provenance import provenance


def cars(*rows: tuple[float, float, float]) -> Boxes:
    """Return cars of 4 x 2 x 1.5 m at x, y and height z, without scores as labels are."""
    return Boxes.from_array(np.array([(x, y, z, 4, 2, 1.5, 0) for x, y, z in rows]).reshape(-1, 7), "Car")


def test_labels_are_missed_coarse_or_exact() -> None:
    ideal = cars((0, 0, 0), (20, 0, 0), (40, 0, 0), (60, 0, 0))
    told = cars((0.1, 0, 0), (21, 0, 0), (40, 0, 0.6), (90, 0, 0))  # 3D IoU .95, .6, .43, and none
    assert grade_labels(ideal, told) == (1, 2, 1)
    assert grade_labels(ideal, cars()) == (4, 0, 0)
    assert grade_labels(cars(), told) == (0, 0, 0)


def test_one_box_finds_one_label() -> None:
    assert grade_labels(cars((0, 0, 0), (0.5, 0, 0)), cars((0.2, 0, 0))) == (1, 0, 1)


def test_the_table_of_labels_has_all_their_fates() -> None:
    score = RoadDetectorResult(
        0.7, 0.7, (), RoadLabels(sweeps=10, beyond=5, missed=2, coarse=3, exact=10, other=3, false=1), provenance()
    )
    rows = detector_tables(score)["labels"].splitlines()
    assert rows[2] == "| all | 20 | 2.00 | 100% |"
    assert rows[3] == "| beyond the field of the trained detector | 5 | 0.50 | 25% |"
    assert RoadDetectorResult.from_json(score.as_json(), "x") == score
