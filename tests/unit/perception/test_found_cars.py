"""Cars near the LiDAR that were found and invented, counted on boxes whose overlaps are known."""

import numpy as np
import pytest

from flcav.geometry import Boxes
from flcav.perception.metrics import FoundCars, count_found_cars


def cars(*rows: tuple[float, float], score: float | None = None) -> Boxes:
    array = np.array([(x, y, -1.0, 4.0, 2.0, 1.5, 0.0) for x, y in rows], float).reshape(-1, 7)
    return Boxes.from_array(array, "Car", None if score is None else np.full(len(rows), score))


NOTHING = cars(score=0.9)


def test_cars_near_by_are_found_once_and_others_are_false():
    targets = cars((10, 0), (20, 0), (0, -39.5), (-45, 0))  # the last is too far
    neutral = cars((30, 5))
    found = cars((11, 0), (22, 0), (0, -40.1), (-45, 0), (30, 5), (15, 12), (15, 60), score=0.9)
    # IoU 3/5, 1/3, .54 by a box that is itself beyond 40 m, on the far car, on a neutral one, on nothing: near, far
    counted = count_found_cars([found], [targets], [neutral])
    assert counted == FoundCars(cars=3, found=2, false_per_quarter_turn=2.0)
    assert "found 2 of 3, and 2.00 false ones a quarter turn" in str(counted)


def test_false_cars_are_shared_out_over_frames_and_looks():
    found, targets = [cars((10, 0), (20, 0), (0, 30), score=0.5), NOTHING], [cars((10, 0)), cars((5, 5))]
    assert count_found_cars(found, targets, [cars(), cars()]) == FoundCars(2, 1, 1.0)
    assert count_found_cars(found, targets, [cars(), cars()], looks=4) == FoundCars(2, 1, 0.25)


def test_detections_below_the_score_count_for_nothing():
    faint = cars((10, 0), (20, 0), score=0.29)
    assert count_found_cars([faint], [cars((10, 0))], [cars()]) == FoundCars(1, 0, 0.0)


def test_two_detections_find_a_car_once():
    found = cars((10, 0), (10.2, 0), score=0.9)
    assert count_found_cars([found], [cars((10, 0))], [cars()]) == FoundCars(1, 1, 1.0)


def test_no_frames_are_refused():
    with pytest.raises(ValueError, match="0 frames"):
        count_found_cars([], [], [])


def test_detections_without_scores_are_refused_and_none_at_all_have_none():
    assert count_found_cars([cars()], [cars((10, 0))], [cars()]) == FoundCars(1, 0, 0.0)
    with pytest.raises(ValueError, match="without scores"):
        count_found_cars([cars((10, 0))], [cars()], [cars()])  # nor is there a target to match them to
