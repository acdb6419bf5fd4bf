"""Ground truth with one fault of the labels at a time."""

import numpy as np
import pytest

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.perception.objects.samples import Sample
from flcav.pipeline.arms import Names, check_federations, resolve_settings
from flcav.pipeline.labels.faults import change_labels, give_fault
from flcav.pipeline.recipe import RunRecipe

POINTS = np.zeros((3, 4), np.float32)


def cars(*places: tuple[float, float, float], height: float = 1.5, score: float | None = None) -> Boxes:
    """Return cars at x, y with these headings, 4 m long."""
    rows = np.array([(x, y, height / 2, 4.0, 1.8, height, yaw) for x, y, yaw in places]).reshape(-1, 7)
    scores = None if score is None else np.full(len(rows), score)
    return Boxes.from_array(rows, np.array(["Car"] * len(rows)), scores)


TRUTH = Sample(POINTS, cars((10, 0, 0), (20, 5, 1)), cars((40, 0, 0)))
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
    changed = change_labels(TRUTH, LABELS, fault)  # type: ignore[arg-type]
    assert changed.boxes.center[:, 0].tolist() == places
    assert changed.ignore.center[:, 0].tolist() == neutral
    assert changed.points is TRUTH.points
    assert changed.boxes.score is None
    right = TRUTH.boxes.array()[1:] if fault == "boxes" else TRUTH.boxes.array()[:1]
    np.testing.assert_array_equal(changed.boxes.array()[1:2] if fault == "boxes" else changed.boxes.array()[:1], right)


@pytest.mark.parametrize("fault", ["missed", "unsure", "false", "boxes"])
def test_nothing_is_labelled_or_nothing_is_there(fault: str) -> None:
    nothing = Sample(POINTS, Boxes.empty())
    unlabelled, empty = (change_labels(*pair, fault) for pair in ((TRUTH, nothing), (nothing, LABELS)))  # type: ignore[arg-type]
    assert len(unlabelled.boxes) == (0 if fault in ("missed", "unsure") else 2)
    assert len(empty.boxes) == (2 if fault == "false" else 0)


def test_every_vehicle_keeps_its_frames() -> None:
    both = {"grid/cav0": [TRUTH, TRUTH], "grid/cav1": [TRUTH]}
    found = give_fault(both, {name: [LABELS] * len(own) for name, own in both.items()}, "missed")
    assert {name: [len(each.boxes) for each in own] for name, own in found.items()} == {
        "grid/cav0": [1, 1],
        "grid/cav1": [1],
    }
    with pytest.raises(ValueError, match="shorter"):
        give_fault(both, {name: [LABELS] for name in both}, "missed")


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
