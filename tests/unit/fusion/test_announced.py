"""Vehicles that announce themselves: moved onto their returns, refused where nothing is, and neutral where unseen."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from flcav.fusion.announced import (
    AGENT,
    Announced,
    is_seen_through,
    place_senders,
    shift_onto_returns,
)
from flcav.fusion.average import BoxReport
from flcav.fusion.tracks import VehicleSweep, track_objects
from flcav.geometry import Boxes
from flcav.network.awareness import AwarenessMessages
from flcav.perception.ops.boxes import iou

CAR = np.array((20.0, 5.0, 0.75, 4.6, 1.8, 1.5, 0.3))
ORIGIN = np.array((0.0, 0.0, 1.8))


def flat(places):
    return np.zeros(len(places))


def cars(senders):
    return np.full(len(senders), "Car")


def messages(*rows):
    """Return messages of sender, time [s], front x, y [m], deviation [m], heading [rad] and speed [m/s]."""
    sender, time_s, x, y, deviation_m, heading, speed = np.array(rows, dtype=np.float64).T
    size, turn_rad = np.tile((4.7, 1.9), (len(rows), 1)), np.full(len(rows), 0.01)
    about = (deviation_m, heading, turn_rad, speed, size, np.full(len(rows), 180))
    return AwarenessMessages(sender.astype(int), time_s, np.c_[x, y], *about)


def moved(box, x, y):
    return box + np.array((x, y, 0, 0, 0, 0, 0))


def announce(*rows, deviation_m):
    """Return vehicles at rest that announce these boxes (7,) with a standard deviation of their positions [m]."""
    variance = np.tile((deviation_m**2, deviation_m**2, 0.04, 0.01, 0.01, 0.04, 0.001), (len(rows), 1))
    boxes = replace(Boxes.from_array(np.array(rows), "Car", np.ones(len(rows))), variance=variance)
    return Announced(BoxReport(AGENT, 0.0, boxes), np.zeros((len(rows), 2)), np.arange(len(rows)))


def scan(*boxes, ground=True):
    """Return the first hits (N, 3) of a LiDAR at `ORIGIN` on boxes (7,) and on the level ground, to 60 m."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-60, 60, 0.4)), np.radians(np.arange(-24, 1, 0.6)))
    rays = np.stack(
        (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), -1
    ).reshape(-1, 3)
    reach = np.where(rays[:, 2] < 0, ORIGIN[2] / np.maximum(-rays[:, 2], 1e-9), np.inf)
    for x, y, z, length, width, height, yaw in boxes:
        turn = np.array(((np.cos(yaw), np.sin(yaw), 0), (-np.sin(yaw), np.cos(yaw), 0), (0, 0, 1)))
        start, way, half = turn @ (ORIGIN - (x, y, z)), rays @ turn.T, np.array((length, width, height)) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-half - start) / way, (half - start) / way
        enters, leaves = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        reach = np.where((enters <= leaves) & (enters > 0), np.minimum(reach, enters), reach)
    hit = reach < 60
    return ORIGIN + rays[hit] * reach[hit, None]


def sweeps(*boxes, found=None):
    """Return sweeps a fifth of a second apart, with the same boxes detected in each."""
    found = Boxes.empty() if found is None else found
    return [VehicleSweep(time_s, found, scan(*boxes), ORIGIN) for time_s in np.arange(-1, 1.01, 0.2)]


def scores(boxes):
    assert boxes.score is not None
    return [*boxes.score]


def overlap(boxes, box):
    return float(iou(torch.from_numpy(boxes.array()), torch.from_numpy(box[None]))[0, 0])


def test_a_sender_is_where_its_messages_put_its_front() -> None:
    heard = messages(
        (7, 9.9, 101.0, 0.0, 0.5, 0.0, 10.0), (7, 10.2, 104.0, 0.0, 0.5, 0.0, 10.0), (3, 9.0, 0, 5, 1, np.pi / 2, 0)
    )
    placed = place_senders(heard, 10.0, flat, cars)
    assert placed.senders.tolist() == [3, 7]
    boxes = placed.report.boxes
    np.testing.assert_allclose(boxes.center[1, :2], (102.0 - 4.65 / 2, 0.0), atol=1e-6)
    np.testing.assert_allclose(boxes.center[0, :2], (0.0, 5.0 - 4.65 / 2), atol=1e-6)
    np.testing.assert_allclose(boxes.size[:, :2], ((4.65, 1.85),) * 2)
    assert boxes.variance is not None
    np.testing.assert_allclose(boxes.variance[:, 0], (1.0, 0.25))
    np.testing.assert_allclose(placed.velocity, ((0.0, 0.0), (10.0, 0.0)), atol=1e-6)


@pytest.mark.parametrize("deviation_m", [0.5, 1.5])
@pytest.mark.parametrize("off", [(0.9, -0.6), (-1.0, 0.7), (0.0, 0.0)])
def test_an_undetected_sender_is_moved_onto_its_returns(off: tuple[float, float], deviation_m: float) -> None:
    told = moved(CAR, *np.array(off) * deviation_m / 1.5)
    found = track_objects(sweeps(CAR), 0.0, (), 0.1, announce(told, deviation_m=deviation_m))
    assert len(found) == 1
    assert scores(found)[0] > 0.99
    assert overlap(found, CAR) > 0.7
    np.testing.assert_allclose(found.size[0, :2], CAR[3:5], atol=0.06)
    assert np.hypot(*shift_onto_returns(CAR, scan(CAR)[:, :3] - (*CAR[:2], 0), 0.05)) < 0.1


def test_a_sender_through_which_the_sweeps_see_is_refused() -> None:
    ghost = moved(CAR, 0, -12)
    for deviation_m in (0.05, 0.5, 1.5):
        assert len(track_objects(sweeps(CAR), 0.0, (), 0.1, announce(ghost, deviation_m=deviation_m))) == 0
    assert is_seen_through(ghost, 0.5, [scan(CAR)], [ORIGIN])
    assert not is_seen_through(CAR, 0.5, [scan(CAR)], [ORIGIN])
    assert not is_seen_through(moved(CAR, 1.5, 1.0), 1.5, [scan(CAR)], [ORIGIN])


def test_what_nobody_could_see_is_neutral() -> None:
    wall = np.array((10.0, 2.5, 2.0, 1.0, 12.0, 4.0, 0.3))
    hidden = track_objects(sweeps(wall, CAR), 0.0, (), 0.1, announce(CAR, deviation_m=0.5))
    assert scores(hidden) == [0.0]  # ignored in the loss
    assert hidden.size[0, 0] > CAR[3] + 0.9  # wherever it may be


def test_announced_sizes_correct_a_track_and_its_detections_place_it() -> None:
    detected = Boxes.from_array(np.array([(*CAR[:3], 3.9, 1.6, 1.5, 0.35)]), ["Car"], [0.4])
    told = moved(CAR, 0.9, 0.9)
    alone = track_objects(sweeps(CAR, found=detected), 0.0, (), 0.1)
    both = track_objects(sweeps(CAR, found=detected), 0.0, (), 0.1, announce(told, deviation_m=1.5))
    assert len(alone) == len(both) == 1
    assert scores(alone)[0] == pytest.approx(0.4)
    assert scores(both)[0] > 0.99
    np.testing.assert_allclose(both.size[0, :2], CAR[3:5], atol=0.06)
    assert overlap(both, CAR) > max(0.75, overlap(alone, CAR) - 0.02)


def test_an_undetected_person_with_a_phone_is_moved_onto_its_returns_or_neutral_behind_a_wall() -> None:
    person = np.array((18.0, 3.0, 0.87, 0.6, 0.6, 1.73, 0.0))
    placed = place_senders(
        messages((1, 0.0, 18.4, 3.0, 2.0, 0.0, 0.0)), 0.0, flat, lambda rows: np.full(len(rows), "Pedestrian")
    )
    assert placed.report.boxes.size[0, 2] == 1.73
    assert placed.report.boxes.variance is not None
    assert placed.report.boxes.variance[0, 3] == pytest.approx(0.09)
    told = announce(moved(person, 1.2, -0.8), deviation_m=2.0)
    found = track_objects(sweeps(person), 0.0, (), 0.1, told)
    assert len(found) == 1
    assert scores(found)[0] > 0.99
    assert np.hypot(*(found.center[0, :2] - person[:2])) < 0.35
    wall = np.array((10.0, 2.5, 2.0, 1.0, 16.0, 4.0, 0.0))
    assert scores(track_objects(sweeps(wall, person), 0.0, (), 0.1, told)) == [0.0]


def test_a_truck_that_announces_itself_gives_no_label_and_a_ghost_on_a_car_none_beside_it() -> None:
    truck = np.array((25.0, -4.0, 1.6, 9.0, 2.5, 3.2, 0.0))
    assert scores(track_objects(sweeps(truck), 0.0, (), 0.1, announce(truck, deviation_m=0.05))) == [0.0]
    detected = Boxes.from_array(CAR, ["Car"], [0.9])
    two = announce(CAR, moved(CAR, 0.4, 0.1), deviation_m=0.5)
    assert len(track_objects(sweeps(CAR, found=detected), 0.0, (), 0.1, two)) == 1


def test_an_undetected_sender_that_moves_is_placed_by_its_own_velocity() -> None:
    velocity = 8.0 * np.array((np.cos(0.3), np.sin(0.3)))
    drive = [
        VehicleSweep(at_s, Boxes.empty(), scan(moved(CAR, *velocity * at_s)), ORIGIN)
        for at_s in np.arange(-1, 1.1, 0.2)
    ]
    told = replace(announce(moved(CAR, 0.5, 0.3), deviation_m=0.5), velocity=velocity[None])
    found = track_objects(drive, 0.0, (), 0.1, told)
    assert len(found) == 1
    assert overlap(found, CAR) > 0.7


def test_a_message_does_not_vouch_for_another_box_than_its_sender_s() -> None:
    """A faint detection on the way of a sender that brakes is no more certain than without its messages."""
    beside = moved(CAR, 0.3, 3.1)
    found = Boxes.from_array(np.array([CAR, beside]), "Car", [0.8, 0.15])
    alone = track_objects(sweeps(CAR, found=found), 0.0, (), 0.1)
    both = track_objects(sweeps(CAR, found=found), 0.0, (), 0.1, announce(CAR, deviation_m=0.5))
    assert sorted(scores(alone)) == pytest.approx([0.15, 0.8])
    assert sorted(scores(both)) == pytest.approx([0.15, 1.0])
