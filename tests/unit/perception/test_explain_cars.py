"""Why cars are missed and invented, on boxes whose overlaps are known."""

import explain_cars as tool
import numpy as np

from flcav.geometry import Boxes, concatenate


def box(x: float, label: str, score: float | None = None) -> Boxes:
    row = np.array([[x, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0]])
    return Boxes.from_array(row, label, None if score is None else np.array([score]))


def test_each_missed_car_has_one_reason():
    cars = concatenate([box(x, "Car") for x in (0, 10, 20, 30, -10, 0)])
    seen = concatenate([box(0, "Car", 0.9), box(12, "Car", 0.9), box(20, "Car", 0.1), box(30, "Cyclist", 0.8)])
    assert tool.explain_missed(seen, cars) == [
        "",
        tool.MISPLACED,
        tool.FAINT,
        tool.OTHERWISE,
        tool.NOT_SEEN,
        tool.TWICE,
    ]


def test_each_false_car_is_on_a_car_or_on_something_else():
    cars, trucks, others = box(0, "Car"), box(10, "Car"), box(20, "Pedestrian")
    seen = concatenate([box(x, "Car", 0.9) for x in (0, 2.5, 10, 20, 30, 45)] + [box(35, "Car", 0.2)])
    assert tool.explain_false(seen, cars, trucks, others) == [tool.SECOND, "Pedestrian", tool.NOTHING]
