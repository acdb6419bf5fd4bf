"""Guards on made-up boxes: what is spoilt in one class, at one distance or of one output refuses by name."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate
from flcav.perception.metrics import match
from flcav.perception.metrics.operating_point import DISTANCES_M
from flcav.perception.objects.truth import FrameTruth
from flcav.releases.verification.comparison import MeasuredNetwork, compare_pair, draw_scenes, measure_results
from flcav.releases.verification.guards import SECTORS_DEG, pair_classes, tabulate
from flcav.releases.verification.testing import ConditionResults, VerificationFrame
from flcav.releases.verification.verify import _find_broken

SCENES = 30
SIZE = {"Car": (4.4, 1.8, 1.6), "Pedestrian": (0.8, 0.6, 1.7), "Cyclist": (1.8, 0.6, 1.7)}
NEAR_M, FAR_M = 20, 40
SIGMA = np.array([0.06, 0.05, 0.04, 0.06, 0.03, 0.04, 0.08])  # of x, y, z, length, width, height, yaw
Change = Callable[[Boxes], Boxes]


def make_truth(scene: int, rng: np.random.Generator) -> FrameTruth:
    """Six objects of each class, at 8 to 46 m, in all directions ahead."""
    labels = np.repeat([*SIZE], 6)
    distance, azimuth = 8 + 2 * np.arange(18) + rng.uniform(0, 2, 18), rng.uniform(-1.2, 1.2, 18)
    distance = distance[rng.permutation(18)]
    center = np.stack((distance * np.cos(azimuth), distance * np.sin(azimuth), np.full(18, -1.0)), axis=1)
    size = np.array([SIZE[label] for label in labels]) * rng.uniform(0.9, 1.1, (18, 1))
    none = Boxes.empty()
    weather = ("clear", "fog")[scene % 2]
    return FrameTruth(f"s{scene}", Boxes(center, size, rng.uniform(-3, 3, 18), labels), none, none, None, weather)


def detect(truth: FrameTruth, rng: np.random.Generator) -> Boxes:
    """A detector that finds four fifths of the objects, with errors of the variances that it says, and invents some."""
    found = truth.targets[np.flatnonzero(rng.random(18) < 0.8)]
    wrong = truth.targets[np.flatnonzero(rng.random(18) < 0.1)]
    rows = found.array() + rng.normal(0, SIGMA, (len(found), 7))
    invented = wrong.array() + np.array([0, 200, 0, 0, 0, 0, 0])  # far from all, until it is drawn near
    invented[:, 1] = rng.uniform(-20, 20, len(wrong))
    invented[:, 2] = 3.0
    rows = np.concatenate((rows, invented))
    label = np.concatenate((found.label, wrong.label))
    score = np.concatenate((rng.uniform(0.6, 1, len(found)), rng.uniform(0.1, 0.6, len(wrong))))
    return replace(Boxes.from_array(rows, label, score), variance=np.broadcast_to(SIGMA**2, (len(rows), 7)))


def run(seed: int, change: Change | None = None) -> ConditionResults:
    """Results of a detector that draws from `seed`, on frames that are always the same."""
    world, own = np.random.default_rng(0), np.random.default_rng(seed)
    truths = tuple(make_truth(scene, world) for scene in range(SCENES))
    boxes = tuple(detect(truth, own) for truth in truths)
    frames = tuple(VerificationFrame(Path("d"), number, "grid", "traffic") for number in range(SCENES))
    return ConditionResults(frames, boxes if change is None else tuple(map(change, boxes)), truths)


@pytest.fixture(scope="module")
def driving() -> MeasuredNetwork:
    return measure_results(run(1))


def find_lost(driving: MeasuredNetwork, candidate: ConditionResults) -> list[str]:
    """Return the guards that a candidate has lost, as "by name"."""
    fog = np.array([truth.weather == "fog" for truth in candidate.truths])
    pairs = [*pair_classes(driving, measure_results(candidate), groups=[("fog", fog)])]
    times = draw_scenes(pairs[0].scene, 200)
    found = (compare_pair(pair, times, len(pairs))[0] for pair in pairs)
    return [f"{each.by} {each.name}" for each in found if each.judgement == "lost"]


def of(label: str, boxes: Boxes) -> NDArray[np.bool_]:
    return boxes.label == label


def distance(boxes: Boxes) -> NDArray[np.float64]:
    return np.hypot(boxes.center[:, 0], boxes.center[:, 1])


def moved(part: int, by: float, label: str, least_m: float = 0.0) -> Change:
    """Return a change of one number of the boxes of a class."""

    def change(boxes: Boxes) -> Boxes:
        rows = boxes.array()
        rows[of(label, boxes) & (distance(boxes) >= least_m), part] += by
        return replace(Boxes.from_array(rows, boxes.label, boxes.score), variance=boxes.variance)

    return change


def scored(score: Callable[[NDArray[np.float64]], NDArray[np.float64]], label: str, least_m: float = 0.0) -> Change:
    """Return a change of the scores of a class."""

    def change(boxes: Boxes) -> Boxes:
        assert boxes.score is not None
        own = of(label, boxes) & (distance(boxes) >= least_m)
        return replace(boxes, score=np.where(own, score(boxes.score), boxes.score))

    return change


def spread(factor: float, part: int, label: str, least_m: float = 0.0) -> Change:
    """Return a change of the standard deviation of one number of the boxes of a class."""

    def change(boxes: Boxes) -> Boxes:
        assert boxes.variance is not None
        variance = boxes.variance.copy()
        variance[of(label, boxes) & (distance(boxes) >= least_m), part] *= factor**2
        return replace(boxes, variance=variance)

    return change


def without(choose: Callable[[Boxes], NDArray[np.bool_]]) -> Change:
    return lambda boxes: boxes[~choose(boxes)]


def phantoms(label: str, at_m: float, count: int = 1) -> Change:
    """Return a change that adds boxes of a class where nothing is."""

    def change(boxes: Boxes) -> Boxes:
        rows = [[at_m, 3.0 * number, 8.0, *SIZE[label], 0.0] for number in range(count)]
        own = replace(Boxes.from_array(rows, label, np.full(count, 0.35)), variance=np.ones((count, 7)))
        return concatenate([boxes, own])

    return change


def repeated(boxes: Boxes) -> Boxes:
    """Return the boxes, and each once more beside itself."""
    assert boxes.score is not None
    return concatenate([boxes, replace(boxes, center=boxes.center + np.array([0, 1.5, 0]), score=boxes.score - 0.01)])


def renamed(boxes: Boxes) -> Boxes:
    return replace(boxes, label=np.where(boxes.label == "Cyclist", "Pedestrian", boxes.label))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "lost"),
    [
        (phantoms("Cyclist", 10), "false Cyclist"),
        (phantoms("Cyclist", 30), "false Cyclist 20-40 m"),
        (phantoms("Pedestrian", 45), "false Pedestrian 40-80 m"),
        (phantoms("Car", 15, 8), "right Car"),
        (repeated, "false Pedestrian"),
        (renamed, "found Cyclist"),
        (moved(6, np.pi, "Cyclist"), "heading Cyclist"),
        (moved(6, np.pi, "Car", FAR_M), "heading Car 40-80 m"),
        (moved(6, 0.3, "Pedestrian"), "error Pedestrian axis"),
        (moved(0, 0.5, "Car"), "error Car x"),
        (moved(1, 0.3, "Car", NEAR_M), "error Car y 20-40 m"),
        (moved(2, 0.4, "Pedestrian"), "error Pedestrian height above ground"),
        (moved(3, 0.6, "Car"), "error Car length"),
        (moved(4, 0.15, "Cyclist"), "error Cyclist width"),
        (moved(5, 0.3, "Pedestrian"), "error Pedestrian height"),
        (moved(0, 0.2, "Car"), "bias Car x too large"),
        (moved(3, -0.2, "Pedestrian"), "bias Pedestrian length too small"),
        (spread(0.16, 2, "Car"), "variance Car height above ground too small"),
        (spread(6.0, 0, "Cyclist"), "variance Cyclist x too large"),
        (spread(0.16, 6, "Pedestrian", NEAR_M), "variance Pedestrian axis too small 20-40 m"),
        (scored(lambda score: 0.3 * score, "Cyclist"), "found Cyclist"),
        (scored(lambda score: 0.3 * score, "Car", FAR_M), "found Car 40-80 m"),
        (scored(lambda score: 0.3 + 0.1 * score, "Pedestrian"), "score Pedestrian too low"),
        (
            without(lambda boxes: np.arctan2(boxes.center[:, 1], boxes.center[:, 0]) > np.pi / 6),
            "found Car 30 to 90 degrees",
        ),
        (without(lambda boxes: boxes.size[:, 0] > 4.4), "found Car longer half"),
        (without(lambda boxes: of("Cyclist", boxes) & (distance(boxes) > FAR_M)), "found Cyclist 40-80 m"),
    ],
)
def test_what_is_spoilt_is_lost_by_name(driving: MeasuredNetwork, change: Change, lost: str):
    assert lost in find_lost(driving, run(1, change))


def test_a_class_that_is_lost_in_one_weather_is_lost(driving: MeasuredNetwork):
    spoilt = run(1)
    boxes = [
        boxes[boxes.label != "Car"] if truth.weather == "fog" else boxes
        for boxes, truth in zip(spoilt.detections, spoilt.truths, strict=True)
    ]
    assert "found Car fog" in find_lost(driving, replace(spoilt, detections=tuple(boxes)))


def test_sectors_and_distances_leave_no_gap_and_overlap_nowhere():
    for borders, ends in ((SECTORS_DEG, (-90, 90)), (DISTANCES_M, (0, 80))):
        assert all(before[1] == after[0] for before, after in pairwise(borders))
        assert (borders[0][0], borders[-1][1]) == ends


@pytest.mark.parametrize("seed", range(1, 6))
def test_detectors_that_differ_by_chance_lose_nothing(driving: MeasuredNetwork, seed: int):
    assert find_lost(driving, run(seed)) == []


def test_the_table_counts_as_the_evaluation_matches(driving: MeasuredNetwork):
    tested = driving.tested
    for label in SIZE:
        table = tabulate(driving, label)
        wanted = [truth.targets[truth.targets.label == label] for truth in tested.truths]
        known = match(
            [boxes[boxes.label == label] for boxes in tested.detections],
            wanted,
            [truth.neutral[truth.neutral.label == label] for truth in tested.truths],
            0.5,
        )
        assert sorted(table.score[table.right]) == pytest.approx(sorted(known.score[known.hit]))
        assert sorted(table.score[~table.right]) == pytest.approx(sorted(known.score[~known.hit]))
        assert sorted(np.abs(table.seen[table.seen > 0])) == pytest.approx(sorted(known.score[known.hit]))
        assert len(table.seen) == known.targets.sum()


def test_boxes_that_are_no_numbers_and_silent_frames_are_told():
    good = run(1)
    assert _find_broken(good, good, "plain") == []
    spoilt = [*good.detections]
    spoilt[3] = replace(spoilt[3], center=spoilt[3].center * np.nan)
    assert _find_broken(good, replace(good, detections=tuple(spoilt)), "noise") == [
        "boxes that are no numbers in 1 frame (noise)"
    ]
    spoilt[3] = spoilt[3][:0]
    assert _find_broken(good, replace(good, detections=tuple(spoilt)), "plain") == [
        "nothing at all is found in 1 frame in which the driving network finds"
    ]
