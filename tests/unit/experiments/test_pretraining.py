from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from flcav.experiments.pretraining import next_factor, own_label_threshold
from flcav.experiments.protocol import Training

from flcav.experiments import pretraining
from flcav.geometry import Boxes
from flcav.perception.objects.evaluate import Asked

TRAINING = Training(max_blocks=6, patience=2, min_gain=0.01, cooldown=(0.3, 0.05))


def factors(aps: list[float], training: Training = TRAINING) -> list[float | None]:
    """Return the factor of each block of a training whose validation reaches `aps`, and what comes after it."""
    return [next_factor(aps[:block], training) for block in range(len(aps) + 1)]


def test_training_cools_down_once_validation_has_levelled_off():
    assert factors([0.1, 0.2, 0.205, 0.209, 0.3, 0.3]) == [1, 1, 1, 1, 0.3, 0.05, None]


def test_a_late_gain_within_the_patience_goes_on_at_the_full_rate():
    assert factors([0.1, 0.2, 0.2, 0.25, 0.25, 0.25]) == [1, 1, 1, 1, 1, 1, 0.3]


def test_the_cooldown_comes_after_the_last_block_too():
    aps = [0.1 * block for block in range(1, 9)]  # never levels off
    assert factors(aps) == [1] * 6 + [0.3, 0.05, None]


def test_fewer_blocks_than_the_patience_needs():
    assert factors([0.5, 0.5, 0.5], TRAINING.model_copy(update={"max_blocks": 1})) == [1, 0.3, 0.05, None]


def test_without_a_cooldown_training_ends_level():
    assert factors([0.5, 0.5, 0.5], TRAINING.model_copy(update={"cooldown": ()})) == [1, 1, 1, None]


def cars(*places: tuple[float, float]) -> Boxes:
    """Return cars ahead at x with a score."""
    rows = [(x, 0.0, 0.0, 4.0, 2.0, 1.6, 0.0) for x, _ in places]
    return Boxes.from_array(np.array(rows).reshape(-1, 7), "Car", [score for _, score in places])


@pytest.mark.parametrize(
    ("scores_of_hits", "scores_of_misses", "threshold"),
    [
        ([0.9, 0.8, 0.7], [], 0.7),
        ([0.9 - i / 100 for i in range(9)], [0.5], 0.5),  # 9 of 10 are right
        ([0.9 - i / 100 for i in range(9)], [0.5, 0.4], 0.5),
        ([0.9, 0.8], [0.85], 0.9),
        ([0.8], [0.9], 1.0),  # nothing is sure enough
        ([], [], 1.0),
    ],
)
def test_own_labels_start_where_nine_of_ten_are_right(
    scores_of_hits: list[float],
    scores_of_misses: list[float],
    threshold: float,
    monkeypatch: pytest.MonkeyPatch,
):
    hits = [(10.0 * i, score) for i, score in enumerate(scores_of_hits, start=1)]
    misses = [(-10.0 * i, score) for i, score in enumerate(scores_of_misses, start=1)]
    truth = Asked("s", cars(*hits), Boxes.empty(), Boxes.empty())
    monkeypatch.setattr(pretraining, "asked_of", lambda frame, config: truth)
    monkeypatch.setattr(pretraining, "detect_all", lambda network, clouds: [cars(*hits, *misses)])

    class OneFrame:
        def __len__(self) -> int:
            return 1

        def frame(self, i: int) -> Any:
            return SimpleNamespace(lidar={"lidar": None})

    network = cast(Any, SimpleNamespace(config=None))
    assert own_label_threshold(network, cast(Any, OneFrame())) == threshold
