import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flcav.geometry import (
    Boxes,
    concatenate,
    count_points_in_boxes,
    inverse,
    is_rigid,
    points_in_boxes,
    pose,
    transform_points,
    unit_vectors,
    wrap_angle,
)

coordinate = st.floats(-100, 100)
angle = st.floats(-10, 10)


@given(coordinate, coordinate, coordinate, angle, angle, angle)
def test_a_pose_times_its_inverse_is_the_identity(x, y, z, yaw, pitch, roll):
    world_from_body = pose(x, y, z, yaw, pitch, roll)
    np.testing.assert_allclose(world_from_body @ inverse(world_from_body), np.eye(4), atol=1e-9)


def test_yaw_turns_forward_to_the_left():
    np.testing.assert_allclose(transform_points(pose(1, 2, yaw=np.pi / 2), [[1.0, 0.0, 0.0]]), [[1, 3, 0]], atol=1e-12)


@given(angle, st.floats(-1.5, 1.5))
def test_unit_vectors_are_the_heading_turned_up(azimuth, elevation):
    expected = pose(0, 0, yaw=azimuth, pitch=-elevation)[:3, 0]
    np.testing.assert_allclose(unit_vectors(azimuth, elevation), expected, atol=1e-12)
    assert unit_vectors(np.zeros(5), np.zeros((3, 1))).shape == (3, 5, 3)


@given(angle)
def test_wrapped_angles_point_the_same_way(value):
    wrapped = float(wrap_angle(value))
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(value), np.sin(value)], atol=1e-9)


@given(coordinate, coordinate, angle)
def test_a_box_holds_its_shrunken_corners_and_not_its_grown_ones(x, y, yaw):
    box = Boxes.from_array([[x, y, 0.8, 4.2, 1.8, 1.6, yaw]], "Car")
    corners = box.corners()[0]
    assert points_in_boxes(box.center + 0.99 * (corners - box.center), box).all()
    assert not points_in_boxes(box.center + 1.01 * (corners - box.center), box).any()


@given(coordinate, coordinate, angle)
def test_boxes_move_as_their_corners_do(x, y, yaw):
    target_from_source = pose(x, y, 1.0, yaw)
    box = Boxes.from_array([[3, -2, 0.8, 4.2, 1.8, 1.6, 0.3]], "Car")
    expected = transform_points(target_from_source, box.corners()[0])
    np.testing.assert_allclose(box.transform(target_from_source).corners()[0], expected, atol=1e-9)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1e155, np.inf, np.nan, -3.0])
def test_a_matrix_of_huge_numbers_is_not_rigid(value: float):
    matrix = np.eye(4)
    matrix[0, 1] = value
    assert not is_rigid(matrix)


def test_variances_of_the_centre_turn_with_the_boxes():
    rng = np.random.default_rng(4)
    variance = rng.uniform(0.1, 2.0, (5, 7))
    rows = rng.uniform(-5, 5, (5, 7))
    boxes = Boxes(rows[:, :3], np.abs(rows[:, 3:6]) + 1, rows[:, 6], np.full(5, "car"), variance=variance)
    turn = pose(3.0, -2.0, 1.0, 0.7, 0.2, -0.1)
    turned = boxes.transform(turn).variance
    assert turned is not None
    for before, after in zip(variance, turned):
        covariance = turn[:3, :3] @ np.diag(before[:3]) @ turn[:3, :3].T
        np.testing.assert_allclose(after[:3], np.diag(covariance))
        np.testing.assert_array_equal(after[3:], before[3:])


def test_points_in_boxes_are_counted_as_they_are_found():
    rng = np.random.default_rng(5)
    cloud = np.pad(rng.uniform(-20, 20, (4000, 3)), ((0, 0), (0, 1))).astype(np.float32)
    moved = pose(200, -80, 3, yaw=1.1, pitch=0.05, roll=-0.02)
    rows = np.c_[rng.uniform(-20, 20, (30, 3)), rng.uniform(0.5, 9, (30, 3)), rng.uniform(-3, 3, 30)]
    boxes = Boxes.from_array(rows, "Car").transform(moved)
    found = points_in_boxes(transform_points(moved, cloud[:, :3].astype(np.float64)), boxes)
    counts = count_points_in_boxes(cloud, boxes, moved)
    assert counts.tolist() == found.sum(axis=1).tolist()
    assert counts.sum() > 100
    assert len(count_points_in_boxes(cloud, boxes[:0], moved)) == 0
    assert count_points_in_boxes(cloud[:0], boxes, moved).tolist() == [0] * 30


def test_no_boxes_of_several_parts_keep_their_scores():
    none = Boxes.from_array(np.zeros((0, 7)), [], score=[])
    assert concatenate([none, none]).score is not None
    assert concatenate([Boxes.empty(), Boxes.empty()]).score is None
    assert len(concatenate([])) == 0


def test_columns_of_boxes_are_those_of_their_array():
    rows = np.arange(14.0).reshape(2, 7)
    boxes = Boxes.from_array(rows, ["Car", "Van"], [0.5, 0.25])
    columns = boxes.columns()
    assert [*columns] == ["label", "x", "y", "z", "length", "width", "height", "yaw", "score"]
    np.testing.assert_array_equal(np.column_stack([columns[name] for name in [*columns][1:8]]), rows)
    assert "score" not in Boxes.from_array(rows, "Car").columns()
