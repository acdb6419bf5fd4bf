"""Objects found and invented by distance, counted on boxes whose overlaps are known."""

import numpy as np
import pytest

from flcav.geometry import Boxes
from flcav.perception.metrics.operating_point import FoundAtDistance, count_by_distance, describe_counts


def cars(*rows: tuple[float, float], score: float | None = None) -> Boxes:
    array = np.array([(x, y, -1.0, 4.0, 2.0, 1.5, 0.0) for x, y in rows], float).reshape(-1, 7)
    return Boxes.from_array(array, "Car", None if score is None else np.full(len(rows), score))


def count(
    found: list[Boxes], targets: list[Boxes], scenes: list[str] | None = None
) -> dict[tuple[int, int], FoundAtDistance]:
    """Return the counts by distance; a car on a neutral place at x = 30, y = 30."""
    neutral = [cars((30, 30))] * len(found)
    names = scenes or [str(number) for number in range(len(found))]
    rows = count_by_distance(found, targets, neutral, names, "Car", np.random.default_rng(0))
    return {row.distance_m: row for row in rows}


def test_each_object_and_each_false_detection_counts_at_its_own_distance() -> None:
    targets = cars((10, 0), (0, -19.8), (25, 0), (60, 0), (90, 0))
    found = cars((11, 0), (0, -20.3), (26.5, 0), (30, 30), (50, 0), (10.2, 0), score=0.5)
    rows = count([found], [targets])  # IoU .6, .6 by a box beyond 20 m, .45, neutral, on nothing, a second one
    assert {span: (row.found, row.targets, row.false_a_frame) for span, row in rows.items()} == {
        (0, 20): (2, 2, 1.0),
        (20, 40): (0, 1, 1.0),
        (40, 80): (0, 1, 1.0),
        (0, 80): (2, 4, 3.0),
    }
    assert "0-20 m   2 of 2 found [1.00, 1.00], 1.00 false a frame [1.00, 1.00]" in describe_counts([*rows.values()])[1]


def test_detections_below_the_score_count_for_nothing_and_ranges_without_any_are_left_out() -> None:
    rows = count([cars((10, 0), (70, 0), score=0.29)], [cars((10, 0))])
    assert {span: (row.found, row.targets) for span, row in rows.items()} == {(0, 20): (0, 1), (0, 80): (0, 1)}
    assert rows[0, 20].false_a_frame == 0
    false = count([cars((10, 0), score=0.9)], [cars()])[0, 20]
    assert (false.recall, false.targets) == (None, 0)
    assert "0-20 m   0 of 0 found, 1.00 false a frame [1.00, 1.00]" in false.describe()


def test_intervals_are_over_scenes_or_over_the_frames_of_one_scene() -> None:
    half = [cars((10, 0), score=0.9), cars(score=0.9)] * 20
    targets = [cars((10, 0))] * 40
    frames = count(half, targets, ["one"] * 40)[0, 20].recall
    scenes = count(half, targets, [str(number // 2) for number in range(40)])[0, 20].recall
    assert scenes == (0.5, 0.5)  # every scene is half found
    assert frames is not None
    assert frames[0] == pytest.approx(0.5 - 1.96 * 0.5 / np.sqrt(40), abs=0.04)
    assert frames[1] == pytest.approx(0.5 + 1.96 * 0.5 / np.sqrt(40), abs=0.04)


def test_detections_without_scores_are_refused() -> None:
    with pytest.raises(ValueError, match="without scores"):
        count([cars((10, 0))], [cars()])
