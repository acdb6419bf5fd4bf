"""Matching and average precision against hand-made cases and a slow, separate implementation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flcav.geometry import Boxes
from flcav.perception.metrics import (
    Matches,
    average_precision,
    bootstrap_interval,
    match,
    orientation_similarity,
    right_headings,
)

CAR = (0.0, 4.0, 1.8, 1.5, 0.0)  # z, length, width, height, yaw


def cars(*xs, scores=None):
    return Boxes.from_array([(x, 0.0, *CAR) for x in xs], "Car", scores)


def slow_ap(matches, frames, worth=lambda turned: 1.0):
    """AP|R40 by its definition: every threshold, every recall, no vectors; `worth` of a hit, by its angle."""
    wanted = sum(int(matches.targets[f]) for f in frames)
    points = []
    for threshold in sorted(set(matches.score.tolist())):
        hits = found = right = 0
        for f in frames:
            for score, hit, turned, frame in zip(
                matches.score, matches.hit, matches.turned, matches.frame, strict=True
            ):
                if frame == f and score >= threshold:
                    found += 1
                    hits += bool(hit)
                    right += worth(turned) if hit else 0.0
        if found:
            points.append((hits / wanted, right / found))
    return sum(max((p for r, p in points if r >= i / 40 - 1e-12), default=0.0) for i in range(1, 41)) / 40


def random_matches(rng, frames=12, detections=60):
    targets = rng.integers(1, 6, frames)
    frame = rng.integers(0, frames, detections)
    hit = rng.random(detections) < 0.5
    for f in range(frames):  # no more hits than objects
        own = np.flatnonzero(hit & (frame == f))
        hit[own[targets[f] :]] = False
    score = np.round(rng.random(detections), 1)  # many ties
    order = np.argsort(-score, kind="stable")
    turned = np.where(hit, rng.choice([0.1, 3.0], detections), np.nan)
    return Matches(score[order], hit[order], turned[order], frame[order], targets)


@pytest.mark.parametrize("seed", range(5))
def test_average_precision_is_its_definition(seed):
    rng = np.random.default_rng(seed)
    matches = random_matches(rng)
    assert average_precision(matches) == pytest.approx(slow_ap(matches, range(12)), abs=1e-12)
    drawn = rng.integers(0, 12, 12)
    assert average_precision(matches, drawn) == pytest.approx(slow_ap(matches, drawn.tolist()), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_orientation_similarity_is_its_definition(seed):
    matches = random_matches(np.random.default_rng(seed))
    wanted = slow_ap(matches, range(12), lambda turned: (1 + math.cos(turned)) / 2)
    assert orientation_similarity(matches) == pytest.approx(wanted, abs=1e-12)
    assert orientation_similarity(matches) < average_precision(matches)


def test_headings_of_found_cars_are_compared_with_those_of_their_targets():
    targets = [
        Boxes.from_array([(x, 0.0, 0.0, 4.0, 1.8, 1.5, yaw) for x, yaw in ((0, 3.1), (20, 0.0), (40, 1.0))], "Car")
    ]
    turned = [
        Boxes.from_array([(x, 0.0, 0.0, 4.0, 1.8, 1.5, yaw) for x, yaw in ((0, -3.1), (20, np.pi), (60, 0))], "Car")
    ]
    matches = match([replace(turned[0], score=np.array([0.9, 0.8, 0.7]))], targets, [Boxes.empty()], 0.5)
    np.testing.assert_allclose(matches.turned, [2 * np.pi - 6.2, np.pi, np.nan])
    assert right_headings(matches) == 0.5
    assert orientation_similarity(matches) == pytest.approx(
        (13 * (1 + np.cos(6.2)) / 2 + 13 * (1 + np.cos(6.2)) / 4) / 40
    )
    assert np.isnan(right_headings(match([Boxes.empty()], targets, [Boxes.empty()], 0.5)))


def test_perfect_and_empty():
    one = [cars(0, 20, scores=[0.9, 0.8])]
    assert average_precision(match(one, [cars(0, 20)], [Boxes.empty()], 0.7)) == 1
    assert average_precision(match([Boxes.empty()], [cars(0)], [Boxes.empty()], 0.5)) == 0
    assert np.isnan(average_precision(match([Boxes.empty()], [Boxes.empty()], [Boxes.empty()], 0.5)))


def test_half_found_scores_half_of_the_recalls():
    matches = match([cars(0, scores=[0.9])], [cars(0, 20)], [Boxes.empty()], 0.5)
    assert average_precision(matches) == pytest.approx(20 / 40)


def test_a_second_detection_of_one_object_is_false():
    matches = match([cars(0, 0.2, scores=[0.5, 0.9])], [cars(0)], [Boxes.empty()], 0.5)
    assert matches.score.tolist() == [0.9, 0.5]
    assert matches.hit.tolist() == [True, False]


def test_neutral_objects_count_neither_way():
    bus = Boxes.from_array([(30, 0, 0.7, 12, 2.5, 3, 0)], "Car")
    found = [cars(0, 28, 60, scores=[0.9, 0.8, 0.7])]  # right, on the bus, nothing there
    matches = match(found, [cars(0)], [bus], 0.5)
    assert matches.score.tolist() == [0.9, 0.7]
    assert matches.hit.tolist() == [True, False]
    assert matches.targets.tolist() == [1]


def test_a_target_goes_before_a_neutral_object():
    matches = match([cars(0, scores=[0.9])], [cars(0)], [cars(0.5)], 0.5)
    assert matches.hit.tolist() == [True]


def test_overlap_counts_height_in_3d_only():
    low = Boxes.from_array([(0, 0, -1, 4, 1.8, 1.5, 0)], "Car", [0.9])
    assert match([low], [cars(0)], [Boxes.empty()], 0.5, "bev").hit.tolist() == [True]
    assert match([low], [cars(0)], [Boxes.empty()], 0.5, "3d").hit.tolist() == [False]


def test_detections_without_scores_are_refused():
    with pytest.raises(ValueError, match="without scores"):
        match([cars(0)], [cars(0)], [Boxes.empty()], 0.5)


def test_interval_holds_the_value_and_shrinks_with_scenes():
    rng = np.random.default_rng(0)
    few, many = random_matches(rng, 10, 80), random_matches(rng, 200, 1600)
    low, high = bootstrap_interval(few, np.arange(10), 300, rng=np.random.default_rng(1))
    assert low <= average_precision(few) <= high
    narrow_low, narrow_high = bootstrap_interval(many, np.arange(200), 300, rng=np.random.default_rng(1))
    assert narrow_high - narrow_low < high - low


def test_frames_of_one_scene_are_redrawn_together():
    matches = random_matches(np.random.default_rng(0))
    halves = np.repeat(["one", "other"], 6)
    low, high = bootstrap_interval(matches, halves, 300, rng=np.random.default_rng(1))
    ends = sorted(average_precision(matches, np.flatnonzero(halves == name)) for name in ("one", "other"))
    assert (low, high) == pytest.approx(ends)  # one of four draws holds one scene twice


def test_one_scene_says_nothing_of_others():
    matches = random_matches(np.random.default_rng(0))
    assert np.isnan(bootstrap_interval(matches, ["only"] * 12, 50, rng=np.random.default_rng(1))).all()
    empty = replace(matches, targets=np.where(np.arange(12) < 3, matches.targets, 0))
    scenes = ["full"] * 3 + ["empty"] * 9
    assert np.isnan(bootstrap_interval(empty, scenes, 50, rng=np.random.default_rng(1))).all()
