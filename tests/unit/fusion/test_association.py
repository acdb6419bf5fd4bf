"""Association of cars found by a LiDAR and by a camera beside it, against a pinhole camera written out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flcav.fusion import association
from flcav.fusion.association import (
    GATE,
    SIDE_PX,
    AssociatedCamera,
    PairedShot,
    _sides,
    apply_error,
    correct_extrinsics,
    fit_extrinsics,
    measure_error,
    outline_cars,
    pair,
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
TRUE = AssociatedCamera(EXACT, SPREAD, INTRINSICS, np.zeros(5), (WIDTH, HEIGHT))
OFF = np.array((*np.radians((0.6, 0.7, -0.4)), 0.15, -0.1, 0.1))  # 1 degree about a slanting axis, 21 cm


def pinhole(cars: Boxes, camera_from_lidar: np.ndarray) -> np.ndarray:
    """Return the boxes (N, 4) of cars, point by point: u = f x / z + cx, and half a pixel to the picture's corner."""
    rows = []
    for points in outline_cars(cars):
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


def shots(number: int = 8) -> tuple[list[PairedShot], list[np.ndarray]]:
    """Return shots whose pictures lack a car and have a false box, and the car of each box (-1: none)."""
    made, truth = [], []
    for seed in range(number):
        cars = street(seed)
        rng = np.random.default_rng(100 + seed)
        boxes = pinhole(cars, EXACT) + rng.normal(0, 1.0, (len(cars), 4))
        order = rng.permutation(len(cars))[1:]
        made.append(PairedShot(cars, np.vstack((boxes[order], (5, 300, 60, 340)))))
        truth.append(np.append(order, -1))
    return made, truth


def share_right(found, truth) -> tuple[float, float]:
    """Return the share of the pictured cars that are rightly paired, and of the pairs that are right."""
    right = sum(int((own[each.box] == each.car).sum()) for each, own in zip(found, truth, strict=True))
    return right / sum(int((own >= 0).sum()) for own in truth), right / max(sum(map(len, found)), 1)


def test_cars_are_projected_as_by_a_pinhole():
    cars = street(3)
    np.testing.assert_allclose(_sides(outline_cars(cars), TRUE), pinhole(cars, EXACT), atol=1e-9)
    behind = replace(cars, center=cars.center * (-1, 1, 1))
    assert np.isnan(_sides(outline_cars(behind), TRUE)).all()


def test_an_error_turns_and_shifts_the_extrinsics():
    moved = apply_error(EXACT, OFF)
    np.testing.assert_allclose(moved[:3, :3], Rotation.from_rotvec(OFF[:3]).as_matrix() @ EXACT[:3, :3])
    assert measure_offset(moved, EXACT).rotation_deg == pytest.approx(np.degrees(np.linalg.norm(OFF[:3])))


def test_all_cars_find_their_boxes_with_one_degree_of_error():
    made, truth = shots()
    found = correct_extrinsics(made, replace(TRUE, camera_from_lidar=apply_error(EXACT, OFF)))
    assert share_right(found.pairs, truth) == (1.0, 1.0)
    assert found.settled
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
    assert after.rotation_deg < 0.2
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
    shot, sure = PairedShot(cars, boxes + np.array((60, 0, 60, 0))), replace(TRUE, covariance=1e-4 * SPREAD)
    alone = pair(shot, sure)
    assert (len(alone), alone.lone_cars.tolist(), alone.lone_boxes.tolist()) == (0, [0], [0])
    assert len(pair(PairedShot(cars, boxes + np.array((2, 0, 2, 0))), sure)) == 1
    monkeypatch.setattr(association, "GATE", 100 * GATE)  # of any number of sides
    assert len(pair(shot, sure)) == 1


def test_without_a_pair_the_calibration_stays():
    found = correct_extrinsics([PairedShot(street(0), np.zeros((0, 4)))], TRUE)
    assert found.view is TRUE
    assert len(found.pairs[0]) == 0
    assert found.settled


def test_a_fit_that_has_not_settled_says_so():
    made, _ = shots()
    off = replace(TRUE, camera_from_lidar=apply_error(EXACT, 4 * OFF), covariance=16 * SPREAD)
    found = correct_extrinsics(made, off, rounds=1)
    assert not found.settled
    now = [pair(shot, found.view).box.tolist() for shot in made]
    assert [each.box.tolist() for each in found.pairs] == now  # the pairs are those of the view


@pytest.mark.parametrize(("sides", "square"), [(1, 10.828), (2, 13.816), (3, 16.266), (4, 18.467)])
def test_the_gate_is_that_of_the_sides_that_count(sides, square, monkeypatch):
    """99.9 % quantiles of chi-squared, as in tables."""
    car, sure = street(0)[:1], replace(TRUE, covariance=1e-12 * SPREAD)
    monkeypatch.setattr(association, "SIDE_SHARE", 0.0)
    monkeypatch.setattr(association, "sides_inside", lambda boxes, view: np.arange(4) < sides)
    for share, paired in ((0.99, 1), (1.01, 0)):
        box = pinhole(car, EXACT) + SIDE_PX * np.sqrt(share * square / sides)
        assert len(pair(PairedShot(car, box), sure)) == paired


def alike() -> Boxes:
    """Return a car 40 m away, and one half as far and half as large, which look the same to the camera."""
    eye = -EXACT[:3, :3].T @ EXACT[:3, 3]
    place = np.array((40.0, 0.0, -5.2))
    center, size = np.array((place, (place + eye) / 2)), np.array((4.4, 1.8, 1.5))
    return Boxes(center, np.array((size, size / 2)), np.zeros(2), np.full(2, "car"))


def test_a_wide_covariance_does_not_win_a_box():
    cars, shifted = alike(), replace(TRUE, covariance=spread_of_calibration(0.01, 0.5))
    boxes = pinhole(cars, EXACT)
    np.testing.assert_allclose(boxes[0], boxes[1], atol=1e-9)
    shot = PairedShot(
        cars, boxes[:1] + np.array((2.0, 0.0, 2.0, 0.0))
    )  # a shift of the camera moves the near one twice as far
    for order in ([0, 1], [1, 0]):
        assert order[pair(replace(shot, cars=cars[order]), shifted).car[0]] == 0
    assert len(pair(replace(shot, cars=cars[1:]), shifted)) == 1  # it would do, were there no other


LARGE = replace(TRUE, covariance=spread_of_calibration(1.5 * np.sqrt(2), 0.3 * np.sqrt(2)))


def neighbours() -> tuple[Boxes, np.ndarray]:
    """Return two cars 2.5 m apart, and boxes (2, 4): that of the first, and a false one as far on its other side."""
    center, size = np.array([(25.0, 0.0, -5.2), (25.0, 2.5, -5.2)]), np.tile((4.4, 1.8, 1.5), (2, 1))
    cars = Boxes(center, size, np.zeros(2), np.full(2, "car"))
    first, second = pinhole(cars, EXACT)
    return cars, np.array((first, first + (first - second)))


def test_a_lone_car_and_a_false_box_do_not_draw_a_right_pair_apart():
    cars, boxes = neighbours()
    for car, box in ((0, 1), (1, 0)):  # within the gate, both
        assert len(pair(PairedShot(cars[[car]], boxes[[box]]), LARGE)) == 1
    found = correct_extrinsics([PairedShot(cars, boxes)], LARGE)
    (pairs,) = found.pairs
    assert (pairs.car.tolist(), pairs.box.tolist()) == ([0], [0])
    assert (pairs.lone_cars.tolist(), pairs.lone_boxes.tolist()) == ([1], [1])
    assert measure_offset(EXACT, found.view.camera_from_lidar).rotation_deg < 0.01


def test_a_pair_less_likely_than_staying_alone_is_made_of_what_stays_alone():
    cars, boxes = neighbours()
    aside = boxes[:1] + np.array((45.0, 0.0, 45.0, 0.0))
    assert len(pair(PairedShot(cars[:1], aside), LARGE)) == 1
    assert pair(PairedShot(cars[:1], np.concatenate((aside, boxes[:1]))), LARGE).box.tolist() == [1]


@pytest.mark.slow
@pytest.mark.parametrize("together", [False, True], ids=["each by itself", "all four of a car together"])
def test_extrinsics_are_as_sure_as_they_are_right_however_sides_err(together: bool):
    squared = []
    for seed in range(24):
        rng, cars = np.random.default_rng(seed), street(seed)
        boxes = pinhole(cars, EXACT)
        whole = np.array([association.side_px(box) for box in boxes])[:, None]
        drawn = rng.normal(0, 1, (len(cars), 1)) * (1, 1, 1, 1) if together else rng.normal(0, 1, (len(cars), 4))
        off = np.linalg.cholesky(SPREAD) @ rng.normal(0, 1, 6)
        calibrated = replace(TRUE, camera_from_lidar=apply_error(EXACT, off))
        shot = PairedShot(cars, boxes + whole * drawn)
        pairs = replace(pair(shot, TRUE), car=np.arange(len(cars)), box=np.arange(len(cars)))
        squared.append(measure_error(EXACT, fit_extrinsics([shot], [pairs], calibrated)))
    assert 2 < np.mean(squared) < 7.5


def test_a_car_that_stands_counts_as_often_as_one_that_is_seen_once():
    def deviations(cars: list[Boxes]) -> np.ndarray:
        made = [PairedShot(each, pinhole(each, EXACT)) for each in cars]
        return np.sqrt(np.diag(fit_extrinsics(made, [pair(each, TRUE) for each in made], TRUE).covariance))

    car = street(0)[:1]
    once = deviations([car])
    np.testing.assert_allclose(deviations([car] * 20), once, rtol=1e-3)
    rolled = [replace(car, center=car.center + np.array((2.0 * step, 0, 0))) for step in range(8)]
    assert (deviations(rolled) < 0.95 * once).any()
    assert (deviations(rolled) <= 1.001 * once).all()
