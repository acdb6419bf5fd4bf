"""The tracker on motion it should follow, and CLEAR MOT on cases counted by hand."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from flcav.config import InputError
from flcav.dataset.layout import FrameKey
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.perception import tracking as tracking_evaluation
from flcav.perception.metrics.tracks import TrackingFrame, amota, count_clear_mot
from flcav.perception.objects import second_tiny
from flcav.perception.tracking import Tracker, TrackState, evaluate_tracks, predict_state, start_state, update_state

from .frames import detections, frame


def cars(*places, yaw=0.0, score=None):
    rows = [(x, y, 0.0, 4.4, 1.8, 1.5, yaw) for x, y in places]
    return Boxes.from_array(np.array(rows).reshape(-1, 7), "Car", np.ones(len(rows)) if score is None else score)


def test_a_filter_is_the_textbooks_on_one_axis():
    variance = np.full(7, 0.25)
    state = start_state(np.zeros(7), variance)
    mean, covariance = np.zeros(2), np.diag((0.25, 64.0))
    for number in range(1, 6):
        dt, seen = 0.5, 1.5 * number
        box = np.zeros(7)
        box[0] = seen
        state = update_state(predict_state(state, dt), box, variance)
        step = np.array(((1, dt), (0, 1)))
        noise = 9.0 * np.array(((dt**4 / 4, dt**3 / 2), (dt**3 / 2, dt**2)))
        mean, covariance = step @ mean, step @ covariance @ step.T + noise
        gain = covariance[:, 0] / (covariance[0, 0] + 0.25)
        mean = mean + gain * (seen - mean[0])
        covariance = covariance - np.outer(gain, covariance[0])
    assert state.mean[[0, 7]] == pytest.approx(mean)
    assert state.covariance[np.ix_((0, 7), (0, 7))] == pytest.approx(covariance)


def test_a_filter_keeps_a_covariance_that_is_one():
    state = start_state(np.zeros(7), np.ones(7))
    for _ in range(50):
        state = update_state(predict_state(state, 0.1), np.zeros(7), np.ones(7))
    assert np.allclose(state.covariance, state.covariance.T)
    assert np.linalg.eigvalsh(state.covariance).min() > 0


def test_a_heading_seen_the_wrong_way_round_does_not_turn_the_track():
    state = TrackState(np.zeros(9), np.eye(9))
    box = np.zeros(7)
    box[6] = np.pi - 0.1
    assert abs(update_state(state, box, np.full(7, 0.1)).mean[6]) < 0.2


def test_cars_that_pass_keep_their_numbers_and_get_their_velocities():
    tracker = Tracker()
    rng = np.random.default_rng(0)
    numbers, velocity = [], np.zeros(3)
    for step in range(20):
        t = 0.5 * step
        noisy = [(10 * t + rng.normal(0, 0.1), 0.0), (60 - 8 * t + rng.normal(0, 0.1), 3.5), (30.0, 7.0)]
        order = rng.permutation(3)
        seen = tracker.step(cars(*[noisy[i] for i in order]), t)
        if step >= 3:
            lanes = np.rint(seen.boxes.center[:, 1] / 3.5).astype(int)
            numbers.append(tuple(seen.track[np.argsort(lanes)]))
            velocity = seen.velocity[np.argsort(lanes), 0]
    assert len(set(numbers)) == 1
    assert velocity == pytest.approx((10, -8, 0), abs=0.5)


def test_a_track_outlives_a_short_gap_and_not_a_long_one():
    tracker = Tracker(patience=2)
    first = [tracker.step(cars((5.0 * t, 0.0)), float(t)) for t in range(4)][-1].track[0]
    for t in (4, 5):
        assert not len(tracker.step(cars(), float(t)).track)
    assert tracker.step(cars((30.0, 0.0)), 6.0).track[0] == first
    for t in (7, 8, 9):
        tracker.step(cars(), float(t))
    tracker.step(cars((50.0, 0.0)), 10.0)
    assert tracker.step(cars((55.0, 0.0)), 11.0).track[0] != first


def test_a_single_detection_is_no_track_yet():
    tracker = Tracker()
    tracker.step(cars((0, 0)), 0.0)
    seen = tracker.step(cars((0, 0), (50, 0)), 0.5)
    assert seen.boxes.center[:, 0] == pytest.approx([0], abs=0.1)


def test_time_does_not_run_backwards():
    tracker = Tracker()
    tracker.step(cars(), 1.0)
    with pytest.raises(ValueError, match="time order"):
        tracker.step(cars(), 0.5)


def moment(objects, tracks, score=None, neutral=None):
    """Objects and tracks are {identity: x}."""
    return TrackingFrame(
        objects=np.array(list(objects), dtype=np.str_),
        places=np.array([(x, 0.0) for x in objects.values()]).reshape(-1, 2),
        tracks=np.array(list(tracks), dtype=np.int64),
        found=np.array([(x, 0.0) for x in tracks.values()]).reshape(-1, 2),
        score=np.array([(score or {}).get(track, 1.0) for track in tracks]),
        neutral=np.array([track in (neutral or ()) for track in tracks], dtype=bool),
    )


def test_clear_counts_by_hand():
    sequence = [
        moment({"a": 0, "b": 10}, {1: 0.5, 2: 10}),  # two pairs
        moment({"a": 1, "b": 11}, {1: 1}),  # b missed
        moment({"a": 2, "b": 12}, {3: 2, 2: 12}),  # a has another track: a switch
        moment({"a": 3, "b": 13}, {3: 3, 2: 13, 4: 40}),  # one false positive
    ]
    counts = count_clear_mot([sequence])
    assert (counts.objects, counts.misses, counts.false_positives, counts.switches) == (8, 1, 1, 1)
    assert counts.mota == pytest.approx(1 - 3 / 8)
    assert counts.motp_m == pytest.approx(0.5 / 7)


def test_a_pair_of_before_stays_though_another_track_comes_closer():
    sequence = [moment({"a": 0}, {1: 0}), moment({"a": 0}, {1: 1.5, 2: 0.1})]
    counts = count_clear_mot([sequence])
    assert (counts.switches, counts.false_positives, counts.misses) == (0, 1, 0)


def test_tracks_of_what_is_neutral_are_not_wrong():
    assert count_clear_mot([[moment({"a": 0}, {1: 0, 2: 30}, neutral=(2,))]]).false_positives == 0


def test_sequences_do_not_share_identities():
    one = [moment({"a": 0}, {1: 0})]
    other = [moment({"a": 0}, {7: 0})]
    assert count_clear_mot([one, other]).switches == 0
    assert count_clear_mot([one + other]).switches == 1


def test_amota_of_perfect_tracks_and_of_half_of_them():
    perfect = [[moment({"a": 0, "b": 10}, {1: 0, 2: 10})] * 4]
    assert amota(perfect) == pytest.approx(1)
    half = [[moment({"a": 0, "b": 10}, {1: 0})] * 4]
    assert amota(half) == pytest.approx(0.5)  # recalls up to a half are reached without a mistake
    assert np.isnan(amota([[moment({}, {})]]))


def test_amota_leaves_out_false_tracks_of_low_score():
    clean = [[moment({"a": 0, "b": 10}, {1: 0, 2: 10, 3: 50}, score={3: 0.1})] * 4]
    worse = [[moment({"a": 0, "b": 10}, {1: 0, 2: 10, 3: 50}, score={1: 0.1})] * 4]
    assert amota(clean) == pytest.approx(1)
    assert amota(worse) < 0.8


class Recording:
    """As much of a dataset as evaluation looks at: one scene, 0.5 s from frame to frame."""

    folder = Path("made up")

    def __init__(self, frames, every_s=0.5):
        self._frames = [replace(one, time_s=every_s * i) for i, one in enumerate(frames)]
        self.keys = [FrameKey(one.scene, i, one.agent, one.time_s) for i, one in enumerate(self._frames)]

    def numbers(self, frames):
        return range(len(self._frames)) if frames is None else frames

    def frame(self, number):
        return self._frames[number]


def drive(steps=8):
    """Return frames of an agent that drives past a car, a bus and a car that has no returns."""
    frames = []
    for i in range(steps):
        objects = [("a", "car", 40 - 2 * i, 3, 20), ("bus", "bus", 30 - 2 * i, -6, 50), ("b", "car", 30, 9, 0)]
        frames.append(frame(objects, at=(2.0 * i, 0.0), index=i))
    return frames


def test_what_is_found_everywhere_is_followed_without_a_mistake(monkeypatch):
    seen = iter(detections((40 - 2 * i, 3, 0.9), (30 - 2 * i, -6, 0.8)) for i in range(8))
    monkeypatch.setattr(tracking_evaluation, "detect_in", lambda network, frames, score_threshold: [next(seen)])
    said = evaluate_tracks(second_tiny(), cast(Dataset, Recording(drive())))
    (row,) = said.scores
    assert (row.objects, row.misses, row.false_positives, row.id_switches) == (8, 0, 0, 0)
    assert row.mota == row.amota == 1
    assert row.velocity_error_mps is not None
    assert row.velocity_error_mps < 0.5  # both stand still in the world
    assert "MOTA 1.000" in said.lines()[1]


def test_frames_too_far_apart_are_refused():
    with pytest.raises(InputError, match="4 s apart"):
        evaluate_tracks(second_tiny(), cast(Dataset, Recording(drive(3), every_s=4.0)))


HEADING = 0.3


def follow(speeds, reversed_in, *, step_s=0.1, noise_m=0.0, size=(4.2, 1.8, 1.5)):
    """Return the headings, less the true one [rad], of a track whose detections are reversed in some frames."""
    tracker, rng, at, off = Tracker(confirm=1), np.random.default_rng(0), 0.0, []
    for number, speed in enumerate(speeds):
        at += speed * step_s
        along = np.array((np.cos(HEADING), np.sin(HEADING))) * at + rng.normal(0, noise_m, 2)
        box = np.r_[along, 0.8, size, HEADING + np.pi * reversed_in(number)]
        told = tracker.step(Boxes.from_array(box[None], "Car"), step_s * number)
        assert told.track.tolist() == [0]
        off.append(float(told.boxes.yaw[0]) - HEADING)
    return np.cos(off)


EVER, NEVER = (lambda n: True), (lambda n: False)


@pytest.mark.parametrize(
    "reversed_in", [EVER, lambda n: n == 0, lambda n: n % 2 == 0], ids=["ever", "first", "every 2nd"]
)
@pytest.mark.parametrize(
    ("speeds", "within"),
    [([10.0] * 12, 6), ([2.0] * 60, 45), ([0.0] * 20 + [*np.arange(0, 8, 0.3)] + [8.0] * 10, 44)],
    ids=["fast", "slow", "late"],
)
def test_a_track_heads_where_it_moves(speeds, within, reversed_in):
    off = follow(speeds, reversed_in)
    assert off[0] == pytest.approx(-1)  # as first detected
    assert off[within:] == pytest.approx(np.ones(len(off) - within), abs=1e-3)
    assert (np.diff(np.sign(off)) != 0).sum() == 1  # turned once


@pytest.mark.parametrize("reversed_in", [EVER, NEVER, lambda n: n % 2 == 0], ids=["ever", "never", "every 2nd"])
def test_a_parked_car_keeps_the_heading_of_its_first_detection(reversed_in):
    off = follow([0.0] * 200, reversed_in, noise_m=0.1)
    assert np.sign(off).tolist() == [1 - 2 * reversed_in(0)] * 200


@pytest.mark.parametrize(
    "speeds",
    [
        [*np.arange(6, -1.5, -0.4)] + [-1.5] * 40 + [*np.arange(-1.5, 5, 0.4)],
        [0.0] * 10 + [-1.5] * 35 + [0.0] * 10 + [4.0] * 30,
        [3.0] * 30 + [-2.5] * 15 + [3.0] * 10 + [-2.5] * 15 + [3.0] * 30,
    ],
    ids=["after a drive", "out of a parking space", "in turns"],
)
def test_a_vehicle_that_backs_up_for_a_moment_keeps_its_heading(speeds):
    assert follow(speeds, NEVER, noise_m=0.05).min() > 0.9


def test_who_walks_does_not_back_up():
    assert follow([1.2] * 60, EVER, size=(0.6, 0.6, 1.7))[20:] == pytest.approx(np.ones(40), abs=1e-3)
