"""The rules of evaluation, of training samples, and of the error registry, on frames made by hand."""

import math
from itertools import chain

import numpy as np
import pytest

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.perception.errors import keep_first, load_errors, save_errors
from flcav.perception.objects import sample_from_frame, second_paper, second_tiny
from flcav.perception.objects.evaluate import ObjectsEvaluation, Score, score_detections
from flcav.perception.objects.samples import validate_points
from flcav.perception.objects.task import find_errors
from flcav.perception.objects.truth import asked_of, ground_truth

from .frames import cloud_in, detections, frame

CONFIG = second_tiny().config
MIXED = [
    ("seen", "car", 10, 0, 5),
    ("van", "van", 20, 0, 9),
    ("faint", "car", 30, 0, 4),
    ("hidden", "car", 40, 0, 0),
    ("bus", "bus", 20, 12, 50),
    ("walker", "pedestrian", 12, -6, 20),
    ("behind", "car", -10, 0, 99),
    ("far", "car", 49, 0, 9),
]


def register(*found, **limits):
    """Return the mistakes of `find_errors`, each once."""
    return keep_first(chain.from_iterable(find_errors(*found, **limits)))


def xs(boxes):
    return sorted(round(float(x)) for x in boxes.center[:, 0])


def test_truth_follows_the_rules():
    truth = asked_of(frame(MIXED, at=(100, 50), yaw=1.0), CONFIG)
    assert xs(truth.targets) == [10, 20]
    assert xs(truth.neutral) == [-10, 20, 30, 40, 49]
    assert xs(truth.hidden) == [40]
    assert set(truth.targets.label) == {"Car"}
    assert np.allclose(truth.targets.center[:, 2], 0.8 - 1.8)


def test_other_classes_are_found_by_networks_that_know_them():
    truth = asked_of(frame(MIXED), second_paper().config)
    assert set(truth.targets.label) == {"Car", "Pedestrian"}


def test_samples_learn_what_was_seen_and_ignore_what_hardly_was():
    sample = sample_from_frame(frame(MIXED), CONFIG)
    assert xs(sample.boxes) == [-10, 10, 20, 49]
    assert xs(sample.ignore) == [20, 30]


def test_points_out_of_every_augmentation_are_left_out():
    points = np.array([[10, 0, 0, 1], [-40, 0, 0, 1], [10, 60, 0, 1], [-3, 20, 0, 1]], dtype=np.float32)
    assert len(sample_from_frame(frame([], points=points), CONFIG).points) == 2


def test_scores_count_targets_and_hidden_objects():
    truths = [asked_of(frame(MIXED, scene=f"s{i}"), CONFIG) for i in range(3)]
    found = [detections((10, 0, 0.9), (20, 0, 0.8), (30, 0, 0.7), (40, 0, 0.6))] * 3
    result = score_detections(found, truths, ("Car",))
    assert [(score.kind, score.iou, score.ap) for score in result[:2]] == [("3d", 0.5, 1), ("3d", 0.7, 1)]
    assert result[0] == Score(
        "Car", "3d", 0.5, ap=1.0, low=1.0, high=1.0, aos=1.0, right_headings=1.0, targets=6, hidden=3
    )
    nothing = score_detections([Boxes.empty()], [asked_of(frame([]), CONFIG)], ("Car",))
    assert nothing[0].ap is None


def test_a_class_of_which_nothing_is_found_lowers_the_score_and_one_without_targets_does_not():
    def row(label, ap):
        return Score(label, "3d", 0.5, ap, None, None, None, None, targets=0 if ap is None else 3, hidden=0)

    rows = (row("Car", 0.8), row("Pedestrian", 0.0), row("Cyclist", None))
    assert ObjectsEvaluation(frames=1, scenes=1, scores=rows, slices=(), trust=()).score == pytest.approx(0.4)
    assert ObjectsEvaluation(frames=1, scenes=1, scores=rows[2:], slices=(), trust=()).score == 0


def test_evaluating_nothing_is_said():
    with pytest.raises(InputError, match="0 frames"):
        score_detections([], [], ("Car",))


def test_misses_are_registered_once_per_track():
    first = frame(MIXED, at=(100, 0), index=0)
    second = frame(MIXED, at=(105, 0), index=1)
    errors = register([first, second], [detections((10, 0, 0.9)), detections((20, 0, 0.9))], CONFIG)
    assert [(e.kind, e.track) for e in errors] == [("miss", "van"), ("miss", "faint"), ("miss", "seen")]
    assert math.isclose(errors[0].x, 120)  # where it was first missed
    assert math.isclose(errors[0].z, 0.8)
    assert (errors[0].returns, errors[0].occlusion, errors[0].label) == (9, 0.25, "Car")
    assert [e.distance_m for e in errors] == pytest.approx(
        [20, 30, 10]
    )  # from the vehicle, not from the world's origin


def test_low_scores_do_not_find():
    errors = register([frame(MIXED[:1])], [detections((10, 0, 0.2))], CONFIG, threshold=0.3)
    assert [e.track for e in errors] == ["seen"]


def test_false_positives_need_a_return_and_are_one_per_place():
    found = detections((10, 0, 0.9), (10, 1.5, 0.8), (30, 5, 0.9), (40, -10, 0.9))
    with_points = cloud_in(found[:3])
    frames = [frame([], points=with_points, index=i) for i in range(2)]
    frames.append(frame([], points=with_points, scene="s1"))
    errors = register(frames, [found] * 3, CONFIG)
    assert [(e.kind, e.scene) for e in errors] == [("false_positive", "s0")] * 2 + [("false_positive", "s1")] * 2
    assert {round(e.x) for e in errors} == {10, 30}
    assert all(math.isclose(e.distance_m, math.hypot(e.x, e.y)) for e in errors)
    assert all(e.returns >= 6 for e in errors)


def test_detections_on_a_bus_or_a_hidden_car_are_no_mistakes():
    found = detections((40, 0, 0.9), (20, 12, 0.9))
    assert register([frame(MIXED[3:5], points=cloud_in(found))], [found], CONFIG) == ()


def test_the_registry_is_a_parquet_table(tmp_path):
    found = detections((30, 5, 0.9))
    errors = register([frame(MIXED[:1], points=cloud_in(found))], [found], CONFIG)
    save_errors(errors, tmp_path / "errors.parquet")
    assert repr(load_errors(tmp_path / "errors.parquet")) == repr(errors)
    save_errors([], tmp_path / "none.parquet")
    assert load_errors(tmp_path / "none.parquet") == ()


@pytest.mark.parametrize(
    ("points", "sentence"),
    [
        (np.zeros((0, 4), np.float32), "empty"),
        (np.zeros((3, 3), np.float32), "shape"),
        (np.full((2, 4), np.nan, np.float32), "2 of 2 points are not finite"),
    ],
)
def test_bad_clouds_are_refused(points, sentence):
    with pytest.raises(InputError, match=sentence):
        validate_points(points, "cloud")


def test_one_rule_says_which_objects_count():
    truth = ground_truth(frame(MIXED), CONFIG)
    names = [row[0] for row in MIXED]
    of = {name: [n for n, own in zip(names, getattr(truth, name), strict=True) if own] for name in RULES}
    assert of == RULES
    assert not (truth.target & truth.faint).any()
    assert truth.boxes.label[names.index("bus")] == "Car"


RULES = {
    "target": ["seen", "van"],
    "faint": ["faint"],
    "hidden": ["hidden"],
    "lookalike": ["bus"],
    "enough": ["seen", "van", "behind", "far"],
}
