"""Association of cars found by a LiDAR and by a camera beside it, against a pinhole camera written out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flcav.fusion import association
from flcav.fusion.association import (
    GATE,
    Shot,
    View,
    apply_error,
    correct_extrinsics,
    outline,
    pair,
    project_cars,
    spread_of_calibration,
)
from flcav.fusion.registration import measure_offset
from flcav.geometry import Boxes

WIDTH, HEIGHT, FOCAL = 640, 384, 320.0
INTRINSICS = np.array([[FOCAL, 0, 319.5], [0, FOCAL, 191.5], [0, 0, 1]])
DOWN = np.radians(20)  # the camera looks along the LiDAR's x, and down
EXACT = np.eye(4)
EXACT[:3, :3] = np.array([[0, -1, 0], [-np.sin(DOWN), 0, -np.cos(DOWN)], [np.cos(DOWN), 0, -np.sin(DOWN)]])
EXACT[:3, 3] = (0.1, 0.2, -0.1)
SPREAD = spread_of_calibration(1.0, 0.2)
TRUE = View(EXACT, SPREAD, INTRINSICS, np.zeros(5), (WIDTH, HEIGHT))
OFF = np.array((*np.radians((0.6, 0.7, -0.4)), 0.15, -0.1, 0.1))  # 1 degree about a slanting axis, 21 cm


def pinhole(cars: Boxes, camera_from_lidar: np.ndarray) -> np.ndarray:
    """Return the boxes (N, 4) of cars, point by point: u = f x / z + cx, and half a pixel to the picture's corner."""
    rows = []
    for points in outline(cars):
        uv = []
        for point in points:
            x, y, z = camera_from_lidar[:3, :3] @ point + camera_from_lidar[:3, 3]
            uv.append((FOCAL * x / z + 319.5 + 0.5, FOCAL * y / z + 191.5 + 0.5))
        (u0, v0), (u1, v1) = np.min(uv, axis=0), np.max(uv, axis=0)
        rows.append((max(u0, 0), max(v0, 0), min(u1, WIDTH), min(v1, HEIGHT)))
    return np.array(rows).reshape(-1, 4)


def street(seed: int, count: int = 6) -> Boxes:
    """Return cars on two lanes, some of them one behind the other, 5.2 m below a LiDAR."""
    rng = np.random.default_rng(seed)
    x = np.sort(rng.uniform(12, 45, count)) + 3.0 * np.arange(count)
    y = rng.choice((-3.0, 3.0), count) + rng.normal(0, 0.3, count)
    size = np.tile((4.4, 1.8, 1.5), (count, 1))
    center = np.column_stack((x, y, np.full(count, -5.2)))
    return Boxes(center, size, rng.choice((0.0, np.pi), count), np.full(count, "car"))


def shots(number: int = 8) -> tuple[list[Shot], list[np.ndarray]]:
    """Return shots whose pictures lack a car and have a false box, and the car of each box (-1: none)."""
    made, truth = [], []
    for seed in range(number):
        cars = street(seed)
        rng = np.random.default_rng(100 + seed)
        boxes = pinhole(cars, EXACT) + rng.normal(0, 1.0, (len(cars), 4))
        order = rng.permutation(len(cars))[1:]
        made.append(Shot(cars, np.vstack((boxes[order], (5, 300, 60, 340)))))
        truth.append(np.append(order, -1))
    return made, truth


def share_right(found, truth) -> tuple[float, float]:
    """Return the share of the pictured cars that are rightly paired, and of the pairs that are right."""
    right = sum(int((own[each.box] == each.car).sum()) for each, own in zip(found, truth, strict=True))
    return right / sum(int((own >= 0).sum()) for own in truth), right / max(sum(map(len, found)), 1)


def test_cars_are_projected_as_by_a_pinhole():
    cars = street(3)
    np.testing.assert_allclose(project_cars(cars, TRUE), pinhole(cars, EXACT), atol=1e-9)
    behind = replace(cars, center=cars.center * (-1, 1, 1))
    assert np.isnan(project_cars(behind, TRUE)).all()


def test_an_error_turns_and_shifts_the_extrinsics():
    moved = apply_error(EXACT, OFF)
    np.testing.assert_allclose(moved[:3, :3], Rotation.from_rotvec(OFF[:3]).as_matrix() @ EXACT[:3, :3])
    assert measure_offset(moved, EXACT).rotation_deg == pytest.approx(np.degrees(np.linalg.norm(OFF[:3])))


def test_all_cars_find_their_boxes_with_one_degree_of_error():
    made, truth = shots()
    found = correct_extrinsics(made, replace(TRUE, camera_from_lidar=apply_error(EXACT, OFF)))
    assert share_right(found.pairs, truth) == (1.0, 1.0)
    assert np.median(np.concatenate([each.residual_px for each in found.pairs])) < 2
    for each, shot in zip(found.pairs, made, strict=True):
        assert len(each) + len(each.lone_boxes) == len(shot.boxes)
        assert len(shot.boxes) - 1 in each.lone_boxes
        assert sorted((*each.car, *each.lone_cars)) == list(range(len(shot.cars)))


def test_the_correction_brings_the_extrinsics_nearer_to_the_true_ones():
    made, _ = shots()
    off = apply_error(EXACT, OFF)
    found = correct_extrinsics(made, replace(TRUE, camera_from_lidar=off)).view
    before, after = measure_offset(EXACT, off), measure_offset(EXACT, found.camera_from_lidar)
    assert before.rotation_deg == pytest.approx(1.0, abs=0.01)
    assert after.rotation_deg < 0.15
    assert after.position_cm < 0.6 * before.position_cm
    assert (np.diag(found.covariance) < np.diag(SPREAD)).all()


def test_without_the_correction_cars_get_the_boxes_of_others():
    made, truth = shots()
    off = replace(TRUE, camera_from_lidar=apply_error(EXACT, 4 * OFF), covariance=16 * SPREAD)
    assert share_right([pair(shot, off) for shot in made], truth)[0] < 0.95
    assert share_right(correct_extrinsics(made, off).pairs, truth)[0] > 0.97


def test_beyond_the_gate_nothing_is_paired(monkeypatch):
    cars = street(0)[:1]
    boxes = pinhole(cars, EXACT)
    shot, sure = Shot(cars, boxes + np.array((60, 0, 60, 0))), replace(TRUE, covariance=1e-4 * SPREAD)
    alone = pair(shot, sure)
    assert (len(alone), alone.lone_cars.tolist(), alone.lone_boxes.tolist()) == (0, [0], [0])
    assert len(pair(Shot(cars, boxes + np.array((2, 0, 2, 0))), sure)) == 1
    monkeypatch.setattr(association, "GATE", 100 * GATE)
    assert len(pair(shot, sure)) == 1


def test_without_a_pair_the_calibration_stays():
    found = correct_extrinsics([Shot(street(0), np.zeros((0, 4)))], TRUE)
    assert found.view is TRUE
    assert len(found.pairs[0]) == 0
