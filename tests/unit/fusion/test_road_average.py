import numpy as np
import pytest

from flcav.fusion.average import LEAST_VARIANCE, BoxReport, average_boxes
from flcav.geometry import Boxes

VARIANCE = np.array((0.04, 0.09, 0.01, 0.04, 0.01, 0.01, 0.01))


def box(x, y, yaw=0.0, score=0.8, scale=1.0, label="car"):
    rows = np.array([[x, y, 0.8, 4.4, 1.8, 1.6, yaw]])
    return Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], np.array([label]), np.array([score]), scale * VARIANCE[None])


def test_different_agents_are_joined_by_inverse_variance() -> None:
    one, other = box(0.0, 0.0), box(0.3, 0.3, scale=4.0)
    found = average_boxes([BoxReport("a", 0.0, one), BoxReport("b", 0.0, other)], 0.0)
    np.testing.assert_allclose(found.boxes.center[0, :2], [0.3 * 0.2, 0.3 * 0.2])  # weights 4/5 and 1/5
    assert found.boxes.variance is not None
    np.testing.assert_allclose(found.boxes.variance[0], VARIANCE * 4 / 5)
    assert found.agents.tolist() == [2]


def test_what_one_agent_repeats_is_joined_by_covariance_intersection() -> None:
    one, other = box(0.0, 0.0), box(0.3, 0.3, scale=4.0)
    found = average_boxes([BoxReport("a", 0.0, one), BoxReport("a", 0.0, other)], 0.0)
    share = np.array([1.0, 0.25]) / 1.25  # in proportion to 1 / trace
    information = share[0] / VARIANCE + share[1] / (4 * VARIANCE)
    assert found.boxes.variance is not None
    np.testing.assert_allclose(found.boxes.variance[0], 1 / information)
    expected = 0.3 * share[1] / (4 * VARIANCE[:2]) / information[:2]
    np.testing.assert_allclose(found.boxes.center[0, :2], expected)


def test_repeating_a_box_makes_it_no_surer() -> None:
    told = [BoxReport("a", 0.1 * number, box(0.0, 0.0)) for number in range(10)]
    variance = average_boxes(told, 0.9).boxes.variance
    assert variance is not None
    np.testing.assert_allclose(variance[0, 2:], np.maximum(VARIANCE, LEAST_VARIANCE)[2:])


def test_a_moving_object_is_one_and_is_moved_to_the_time_asked_for() -> None:
    told = [BoxReport(agent, 0.5 * n, box(5.0 * n, -1.0)) for n in range(4) for agent in ("a", "b")]  # 10 m/s
    found = average_boxes(told, 2.0)
    assert len(found.boxes) == 1
    np.testing.assert_allclose(found.velocity[0], [10.0, 0.0], atol=0.05)
    np.testing.assert_allclose(found.boxes.center[0, :2], [20.0, -1.0], atol=0.05)


def test_near_objects_and_other_classes_stay_apart() -> None:
    told = [
        BoxReport("a", 0.0, box(0.0, 0.0)),
        BoxReport("b", 0.0, box(0.1, 0.0, label="bus")),
        BoxReport("c", 0.0, box(0.0, 3.5)),
    ]
    found = average_boxes(told, 0.0)
    assert sorted(found.boxes.label.tolist()) == ["bus", "car", "car"]
    assert [members.tolist() for members in found.member] == [[0], [1], [2]]


def test_headings_are_averaged_as_axes_and_the_surer_way_wins() -> None:
    told = [
        BoxReport("a", 0.0, box(0, 0, yaw=3.1)),
        BoxReport("b", 0.0, box(0, 0, yaw=-3.1)),
        BoxReport("c", 0.0, box(0, 0, yaw=0.04)),
    ]
    (yaw,) = average_boxes(told, 0.0).boxes.yaw
    assert abs(abs(yaw) - np.pi) < 0.05


def test_scores_count_the_spins_without_the_object_and_agents_err_independently() -> None:
    empty = Boxes.empty()
    told = [
        BoxReport("a", 0.0, box(0, 0, score=0.8)),
        BoxReport("a", 0.1, empty),
        BoxReport("b", 0.0, box(0, 0, score=0.5)),
    ]
    found = average_boxes(told, 0.1)
    assert found.boxes.score is not None
    np.testing.assert_allclose(found.boxes.score, [1 - (1 - 0.4) * (1 - 0.5)])


@pytest.mark.parametrize("told", [[], [BoxReport("a", 0.0, Boxes.empty())]])
def test_nothing_told_is_no_object(told) -> None:
    assert len(average_boxes(told, 0.0).boxes) == 0
