"""The count of found and invented cars, on boxes whose overlaps are known."""

import count_cars
import numpy as np

from flcav.geometry import Boxes
from flcav.perception.objects.config import small_config
from flcav.perception.objects.model import second
from flcav.perception.objects.truth import GroundTruth


def boxes(rows: list[tuple[float, float]], label: str, score: float | None = None) -> Boxes:
    made = [(x, y, -1.0, 4.0, 2.0, 1.5, 0.0) for x, y in rows]
    scores = None if score is None else np.full(len(rows), score)
    return Boxes.from_array(np.array(made, float).reshape(-1, 7), label, scores)


def test_a_view_counts_found_false_and_neutral_detections():
    there = boxes([(10, 0), (20, 0), (30, 5), (35, -9), (45, 0)], "Car")  # the third is a truck, the last too far
    truth = GroundTruth(
        there,
        returns=np.array([50, 50, 50, 3, 50]),
        inside=np.ones(5, bool),
        lookalike=np.array([False, False, True, False, False]),
    )
    # IoU 3/5 on the first, 1/3 beside the second, one on the truck, one on the faint car, one where nothing is
    seen = boxes([(11, 0), (22, 0), (30, 5), (35, -9), (15, 12)], "Car", 0.9)
    total = count_cars.Count()
    count_cars._add(total, seen, there, truth, second(small_config()))
    assert (total.asked, total.found, total.false) == (2, 1, 2)
    assert total.others == 0
    assert "1 of 2 cars found, 2.00 false cars" in str(total)
