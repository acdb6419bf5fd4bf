"""Ground truth with one fault of the labels at a time."""

import numpy as np
import pytest

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.perception.objects.config import CONFIGURATIONS
from flcav.perception.objects.loss import assign_anchors, classification_loss
from flcav.perception.objects.predict import predict
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import Names, resolve_settings
from flcav.runs.labels.faults import change_labels, give_fault
from flcav.runs.recipe import RunRecipe

POINTS = np.zeros((3, 4), np.float32)


def cars(*places: tuple[float, float, float], height: float = 1.5, score: float | None = None) -> Boxes:
    """Return cars at x, y with these headings, 4 m long."""
    rows = np.array([(x, y, height / 2, 4.0, 1.8, height, yaw) for x, y, yaw in places]).reshape(-1, 7)
    scores = None if score is None else np.full(len(rows), score)
    return Boxes.from_array(rows, np.array(["Car"] * len(rows)), scores)


TRUTH = Sample(POINTS, cars((10, 0, 0), (20, 5, 1)), cars((40, 0, 0)))
HIDDEN = np.array([0.9, 0.2])
LABELS = Sample(POINTS, cars((10.4, 0.1, 0.02), (30, -5, 0), height=1.8, score=0.7))  # one near, one of nothing


@pytest.mark.parametrize(
    ("fault", "places", "neutral"),
    [
        ("missed", [10.0], [40.0]),
        ("unsure", [10.0], [40.0, 20.0]),
        ("false", [10.0, 20.0, 30.0], [40.0]),
        ("boxes", [10.4, 20.0], [40.0]),
    ],
)
def test_one_fault_changes_one_thing(fault: str, places: list[float], neutral: list[float]) -> None:
    changed = change_labels(TRUTH, LABELS, HIDDEN, fault)  # type: ignore[arg-type]
    assert changed.boxes.center[:, 0].tolist() == places
    assert changed.ignore.center[:, 0].tolist() == neutral
    assert changed.points is TRUTH.points
    assert changed.boxes.score is None
    right = TRUTH.boxes.array()[1:] if fault == "boxes" else TRUTH.boxes.array()[:1]
    np.testing.assert_array_equal(changed.boxes.array()[1:2] if fault == "boxes" else changed.boxes.array()[:1], right)


def test_of_what_is_missed_it_is_the_far_or_the_occluded_alone() -> None:
    """Objects at 10 and 30 m are labelled, of those at 20, 25, 40 m and at 5 m none; occlusion unknown is none."""
    truth = Sample(POINTS, cars((10, 0, 0), (20, 0, 0), (25, 0, 0), (0, 40, 0), (30, 0, 0), (5, 0, 0)))
    hidden = np.array([0.9, 0.5, 0.49, np.nan, 1.0, 0.0])
    labels = Sample(POINTS, cars((10, 0, 0), (30, 0, 0), score=0.7))
    left = {
        fault: change_labels(truth, labels, hidden, fault).boxes.center[:, :2].tolist()  # type: ignore[arg-type]
        for fault in ("missed", "range", "occlusion")
    }
    assert left["missed"] == [[10, 0], [30, 0]]
    assert left["range"] == [[10, 0], [20, 0], [30, 0], [5, 0]]
    assert left["occlusion"] == [[10, 0], [25, 0], [0, 40], [30, 0], [5, 0]]


def test_presence_teaches_where_objects_are_and_no_box() -> None:
    """Whatever the boxes' heights and headings, the loss of presence is the same, and it is that of the scores."""
    network, points = build_network(OBJECTS, CONFIGURATIONS["pillars"], 1), np.ones((9, 4), np.float32)
    losses = []
    for boxes in (cars((10, 0, 0)), cars((10, 0, 0), height=2.5), cars((10, 0, np.pi))):
        sample = change_labels(Sample(points, boxes), LABELS, np.zeros(1), "presence")
        assert sample.boxes is boxes
        losses.append(OBJECTS.loss(network.eval(), [sample]).item())
    assert losses[0] == losses[1] == losses[2]
    targets = [assign_anchors(sample, network.config)]
    scores = classification_loss(predict(network, [points]), targets, network.config)
    assert losses[0] == pytest.approx(scores.item())


@pytest.mark.parametrize("fault", ["missed", "unsure", "range", "occlusion", "false", "boxes", "presence"])
def test_nothing_is_labelled_or_nothing_is_there(fault: str) -> None:
    nothing = Sample(POINTS, Boxes.empty())
    pairs = ((TRUTH, nothing, HIDDEN), (nothing, LABELS, np.empty(0)))
    unlabelled, empty = (change_labels(*pair, fault) for pair in pairs)  # type: ignore[arg-type]
    assert len(unlabelled.boxes) == {"missed": 0, "unsure": 0, "occlusion": 1}.get(fault, 2)
    assert len(empty.boxes) == (2 if fault == "false" else 0)


def test_every_vehicle_keeps_its_frames() -> None:
    both = {"grid/cav0": [TRUTH, TRUTH], "grid/cav1": [TRUTH]}
    hidden = {name: [HIDDEN] * len(own) for name, own in both.items()}
    found = give_fault(both, {name: [LABELS] * len(own) for name, own in both.items()}, hidden, "missed")
    assert {name: [len(each.boxes) for each in own] for name, own in found.items()} == {
        "grid/cav0": [1, 1],
        "grid/cav1": [1],
    }
    with pytest.raises(ValueError, match="shorter"):
        give_fault(both, {name: [LABELS] for name in both}, hidden, "missed")


def recipe(labels: str) -> RunRecipe:
    return RunRecipe.model_validate(
        {
            "tasks": {"objects": {"labels": labels, "plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}}},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}},
            "budgets_mb": {"wireless": 9, "wireline": 9},
            "arms": {"lost": {"fault": "missed", "stages": ["edge"]}, "noisy": {"fault": "boxes", "stages": ["edge"]}},
        }
    )


def test_arms_of_a_fault_share_tracks_but_not_training() -> None:
    asked = recipe("tracks")
    settings = resolve_settings(asked)
    names = Names(settings)
    check_federations(asked, settings.values())
    assert len({names.tracks(arm, "grid", "objects") for arm in settings}) == 1
    assert len({names.edge(arm, "grid", "objects") for arm in settings}) == 3


def test_a_fault_of_labels_that_are_no_tracks_is_refused() -> None:
    asked = recipe("road")
    with pytest.raises(InputError, match="arm 'lost': fault: 'missed' is one of labels by tracks; choose 'tracks'"):
        check_federations(asked, resolve_settings(asked).values())
