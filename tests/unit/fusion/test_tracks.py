"""Labels from a vehicle's drive: boxes fitted to the returns of a track are those of the object that was scanned."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.fusion.average import BoxReport
from flcav.fusion.tracks import VehicleSweep, fit_vehicle, track_objects
from flcav.geometry import Boxes, heading_vectors
from flcav.perception.ops.boxes import iou

LIDAR_M = 1.8


def scan(box, origin, beams=64, rng=None):
    """Returns (N, 3) of a LiDAR at `origin` from the sides and the roof of a box (7,) that it sees, world frame."""
    rng = np.random.default_rng(0) if rng is None else rng
    x, y, z, length, width, height, yaw = box
    along = heading_vectors(yaw)
    axes = np.array([along, (-along[1], along[0])])
    seen_from = axes @ (np.asarray(origin)[:2] - (x, y))
    parts = []
    heights = np.linspace(0.05, 0.97, beams // 4) * height
    for axis, half, other in ((0, length / 2, width / 2), (1, width / 2, length / 2)):
        if abs(seen_from[axis]) <= half:
            continue  # no view of either face
        face = np.sign(seen_from[axis]) * half
        along_face = rng.uniform(-other, other, (len(heights), 60))
        plane = np.stack((np.full(along_face.shape, face), along_face), -1)
        plane = plane if axis == 0 else plane[..., ::-1]
        parts.append(np.concatenate((plane, np.broadcast_to(heights[:, None, None], (*along_face.shape, 1))), -1))
    if origin[2] > height:  # the roof
        roof = rng.uniform((-length / 2, -width / 2), (length / 2, width / 2), (1, 300, 2))
        parts.append(np.concatenate((roof, np.full((1, 300, 1), height)), -1))
    local = np.concatenate([each.reshape(-1, 3) for each in parts])
    return np.c_[local[:, :2] @ axes + (x, y), local[:, 2] + z - height / 2] + rng.normal(0, 0.01, (len(local), 3))


def overlap(a, b):
    return float(iou(torch.from_numpy(np.atleast_2d(a)), torch.from_numpy(np.atleast_2d(b)))[0, 0])


def fitted(true, detected, origin, **how):
    returns = scan(true, origin, **how) - (*detected[:2], detected[2] - detected[5] / 2)
    inside = (returns[:, 2] > 0.25) & (returns[:, 2] < 3.6)
    relative = np.asarray(origin) - (*detected[:2], detected[2] - detected[5] / 2)
    return fit_vehicle(np.asarray(detected), returns[inside], relative)


@settings(max_examples=60, deadline=None, derandomize=True)  # rare vehicles are fitted less well
@given(
    longer=st.floats(-0.3, 0.9),
    width=st.floats(1.65, 1.95),
    height=st.floats(1.4, 2.6),
    yaw=st.floats(-3.1, 3.1),
    side=st.floats(0.35, 1.2),
    turned=st.floats(-0.1, 0.1),
    off=st.floats(-0.05, 0.05),
)
def test_a_vehicle_of_any_size_is_fitted_though_it_was_detected_as_a_small_one(
    longer, width, height, yaw, side, turned, off
):
    """From a corner both of its sides are seen; vehicles of a height are longer and shorter than they mostly are."""
    length = 2.35 + 1.4 * height + longer
    true = np.array((20.0, 5.0, height / 2, length, width, height, yaw))
    away = 12 * heading_vectors(yaw + side)
    origin = (20.0 + away[0], 5.0 + away[1], LIDAR_M)
    detected = np.array((20.0 + off, 5.0 - off, 0.73, 4.0, 1.75, 1.46, yaw + turned))
    found = fitted(true, detected, origin)
    assert overlap(found, true) > max(0.6, overlap(detected, true) - 0.05)
    assert found[2] - found[5] / 2 == pytest.approx(0.0, abs=1e-6)  # its underside stays
    assert found[5] == pytest.approx(height, abs=0.2)
    assert abs(np.sin(found[6] - yaw)) < 0.04


def test_the_side_that_is_not_seen_is_where_the_box_grows():
    """Of a van straight ahead only the back is seen: that stays in place, and it is as long as others of its height."""
    true = np.array((20.0, 0.0, 1.0, 5.2, 1.9, 2.0, 0.0))
    found = fitted(true, np.array((19.4, 0.0, 0.73, 4.0, 1.8, 1.46, 0.0)), (0.0, 0.0, LIDAR_M))
    assert found[0] - found[3] / 2 == pytest.approx(20.0 - 5.2 / 2, abs=0.1)
    assert found[3] == pytest.approx(2.35 + 1.4 * 2.0, abs=0.2)


def test_an_object_beside_is_no_part_of_it():
    """The gap to a car parked behind ends the box."""
    true = np.array((20.0, 4.0, 0.75, 4.4, 1.8, 1.5, 0.0))
    behind = true + np.array((5.2, 0, 0, 0, 0, 0, 0))
    origin = (14.0, -2.0, LIDAR_M)
    detected = np.array((20.0, 4.0, 0.75, 4.1, 1.75, 1.5, 0.05))
    both = np.concatenate((scan(true, origin), scan(behind, origin))) - (20.0, 4.0, 0.0)
    found = fit_vehicle(detected, both[both[:, 2] > 0.25], np.array(origin) - (20.0, 4.0, 0.0))
    assert found[3] == pytest.approx(4.45, abs=0.2)
    assert overlap(found, true) > 0.85


def test_with_few_returns_the_box_stays():
    box = np.array((20.0, 4.0, 0.75, 4.4, 1.8, 1.5, 0.3))
    assert fit_vehicle(box, np.array([(0.0, 0.0, 0.5)] * 5), np.array((-20.0, 0, 1.8))) is box
    assert fit_vehicle(box, np.zeros((0, 3)), np.full(3, np.inf)) is box


def drive(true, speed=0.0, every=5, missed=(), ghosts=()):
    """Sweeps of a vehicle that drives along x at 8 m/s and passes `true`, which moves along its heading at `speed`."""
    rng, sweeps = np.random.default_rng(3), []
    for number in range(-every, every + 1):
        time_s, origin = 10 + number * 0.2, np.array((8 * number * 0.2, 0.0, LIDAR_M))
        place = true.copy()
        place[:2] += speed * number * 0.2 * heading_vectors(true[6])
        rows = [] if number in missed else [place + rng.normal(0, (0.1, 0.1, 0.01, 0.1, 0.05, 0.02, 0.03))]
        rows = [row - (0, 0, (true[5] - 1.46) / 2, true[3] - 4.0, true[4] - 1.75, true[5] - 1.46, 0) for row in rows]
        rows += [np.array((30.0, -8.0, 0.73, 4, 1.75, 1.46, 0))] if number in ghosts else []
        boxes = Boxes.from_array(np.array(rows).reshape(-1, 7), "Car", np.full(len(rows), 0.8))
        sweeps.append(VehicleSweep(time_s, boxes, scan(place, origin, rng=rng), origin))
    return sweeps


@pytest.mark.parametrize("speed", [0.0, 9.0])
def test_tracks_have_the_size_and_the_place_of_the_object(speed):
    true = np.array((18.0, 5.0, 1.0, 5.1, 1.95, 2.0, 0.2))
    (found,) = track_objects(drive(true, speed), 10.0).array()
    assert overlap(found, true) > 0.75
    assert found[3:6] == pytest.approx(true[3:6], abs=0.25)


def test_a_gap_in_the_detections_is_filled_and_a_single_one_is_no_label():
    """The score is the mean over the sweeps: an object missed in the frame itself has a label, a single ghost not."""
    true = np.array((18.0, 5.0, 0.75, 4.4, 1.8, 1.5, 0.0))
    found = track_objects(drive(true, missed=(0, 1), ghosts=(2,)), 10.0)
    assert found.score is not None
    score = found.score[np.argsort(-found.score)]
    assert score == pytest.approx([0.8 * 9 / 11, 0.8 / 11])
    assert len(track_objects(drive(true, missed=(0, 1), ghosts=(2,)), 10.0, least=0.1)) == 1


def test_boxes_of_a_road_sensor_join_the_tracks():
    true = np.array((18.0, 5.0, 0.75, 4.4, 1.8, 1.5, 0.0))
    far = Boxes.from_array(np.array([true, (60.0, 20.0, 0.75, 4.4, 1.8, 1.5, 0.0)]), "Car", np.array([0.9, 0.9]))
    found = track_objects(drive(true), 10.0, [BoxReport("pole 1", 10.0, far)])
    assert found.score is not None
    assert sorted(found.score) == pytest.approx(sorted((1 - 0.2 * 0.1, 0.9)))


def test_those_on_foot_keep_their_average():
    person = np.array((18.0, 5.0, 0.9, 0.6, 0.6, 1.7, 0.0))
    sweeps = drive(person)
    walking = [replace(each, boxes=Boxes.from_array(person[None], "Pedestrian", np.ones(1))) for each in sweeps]
    np.testing.assert_allclose(track_objects(walking, 10.0).array()[0], person, atol=1e-9)


def test_nothing_detected_is_nothing_labelled():
    sweeps = [replace(each, boxes=Boxes.from_array(np.zeros((0, 7)), "", np.zeros(0))) for each in drive(np.ones(7))]
    assert len(track_objects(sweeps, 10.0)) == 0


def test_the_underside_is_where_the_vehicle_saw_it_whatever_a_road_sensor_tells():
    true = np.array((18.0, 5.0, 0.75, 4.4, 1.8, 1.5, 0.0))
    lifted = Boxes.from_array(np.array([(*true[:2], true[2] + 0.3, *true[3:])]), "Car", np.ones(1))
    sure = replace(lifted, variance=np.full((1, 7), 1e-4))
    (found,) = track_objects(drive(true), 10.0, [BoxReport("pole 1", 10.0, sure)]).array()
    assert found[2] - found[5] / 2 == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("length", "score"), [(5.9, 0.8), (8.0, 0.0)])
def test_a_van_is_a_label_and_a_lorry_is_none(length, score):
    true = np.array((20.0, 6.0, 1.25, length, 2.0, 2.5, 0.0))
    sweeps = [
        replace(each, boxes=Boxes.from_array(np.array([(*true[:2], 1.1, 5.5, 2.0, 2.2, 0.0)]), "Car", np.array([0.8])))
        for each in drive(true)
    ]
    found = track_objects(sweeps, 10.0)
    assert found.score == pytest.approx([score])
