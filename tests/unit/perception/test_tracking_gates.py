"""Pairs of a track and a detection at the edges of the gates: statistical distance, and how far a car can get."""

import numpy as np
import pytest
from scipy import stats

from flcav.perception.tracking import LEAST_VARIANCE, TrackState, associate_detections, innovation

WIDE = 1e6  # variance [m^2] with which every place is likely


def state(variance: tuple[float, float]) -> TrackState:
    return TrackState(np.zeros(9), np.diag([*variance, *[1.0] * 7]))


def pairs(own: TrackState, place: tuple[float, float], after_s: float, yaw: float = 0.0) -> list[tuple[int, int]]:
    return associate_detections([own], np.array([[*place, 0, 0, 0, 0, yaw]]), np.zeros((1, 7)), after_s)


@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2, -2.0])
def test_a_pair_is_within_the_99_percent_ellipse_of_the_prediction(angle: float) -> None:
    variance = np.array((4.0, 0.25))
    spread = np.sqrt(variance + LEAST_VARIANCE[:2])
    limit = np.sqrt(round(float(stats.chi2.ppf(0.99, 2)), 2))
    direction = np.array((np.cos(angle), np.sin(angle))) * spread
    own = state((4.0, 0.25))
    for factor, wanted in ((0.999, [(0, 0)]), (1.001, [])):
        x, y = (factor * limit * direction).tolist()
        assert pairs(own, (x, y), 1.0) == wanted


@pytest.mark.parametrize("after_s", [0.0, 0.1, 0.5, 2.0])
def test_a_pair_is_no_farther_than_40_metres_a_second_and_2_metres(after_s: float) -> None:
    own, reach = state((WIDE, WIDE)), 2.0 + 40.0 * after_s
    for place in ((reach, 0.0), (0.0, -reach), (0.6 * reach * 0.9999, 0.8 * reach * 0.9999)):
        assert pairs(own, place, after_s) == [(0, 0)]
    for place in ((reach + 0.001, 0.0), (0.0, -reach - 0.001), (0.6 * reach * 1.001, 0.8 * reach * 1.001)):
        assert pairs(own, place, after_s) == []


def test_of_detections_in_the_gate_the_likeliest_pairs_are_taken_and_others_are_left() -> None:
    first, second = state((1.0, 1.0)), state((1.0, 1.0))
    second.mean[0] = 3.0
    boxes = np.zeros((3, 7))
    boxes[:, 0] = (2.9, 0.3, 50.0)
    assert sorted(associate_detections([first, second], boxes, np.zeros((3, 7)), 2.0)) == [(0, 1), (1, 0)]
    vague = state((900.0, 900.0))  # as near, and less likely: its spread is larger
    assert associate_detections([vague, state((1.0, 1.0))], boxes[1:2], np.zeros((1, 7)), 2.0) == [(1, 0)]


@pytest.mark.parametrize(("yaw", "turn"), [(np.pi / 2 - 0.01, np.pi / 2 - 0.01), (np.pi / 2 + 0.01, 0.01 - np.pi / 2)])
def test_a_heading_is_turned_beyond_90_degrees(yaw: float, turn: float) -> None:
    off, spread = innovation(state((1.0, 1.0)), np.array([0, 0, 0, 0, 0, 0, yaw]), np.zeros(7))
    assert off[6] == pytest.approx(turn)
    assert np.diag(spread) == pytest.approx(1.0 + LEAST_VARIANCE)
