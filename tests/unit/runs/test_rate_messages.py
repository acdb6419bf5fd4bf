"""Precision and recall of labels by distance, and of cars that drive, on boxes whose overlaps are known."""

import numpy as np
import rate_messages as tool

from flcav.geometry import Boxes
from flcav.perception.objects.truth import FrameTruth


def boxes(*ahead_m: float) -> Boxes:
    rows = np.array([(x, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0) for x in ahead_m]).reshape(-1, 7)
    return Boxes.from_array(rows, "Car", np.ones(len(rows)))


def test_labels_are_rated_by_distance_and_by_who_drives():
    truths = [FrameTruth("a", boxes(10, 25, 30, 40), boxes(50), boxes())]
    found = [boxes(10, 17, 25, 33, 40.2, 50)]  # the one on a neutral object counts neither way
    drives = [np.array([True, True, False, False])]
    assert tool.rate(found, truths, drives) == [
        *("0.60", "0.50", "0.50", "1.00"),  # precision: in all, below 20 m, to 35 m, beyond
        *("0.75", "1.00", "0.50", "1.00"),  # recall
        *("1.00", "0.50"),  # of cars that drive, and that park
    ]
    assert len([*tool.list_rows()]) == 1 + 9 + 9 + 3
