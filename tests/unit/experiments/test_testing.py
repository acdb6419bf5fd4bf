from pathlib import Path

import numpy as np
import pytest

from flcav.experiments import testing
from flcav.geometry import Boxes
from flcav.perception.objects.evaluate import Asked, Evaluation, score_detections

SCENES = 6


def evaluation(found: int) -> Evaluation:
    """Return the evaluation of a detector that finds `found` of the three cars of every frame, two frames a scene."""
    rows = np.array([(x, 0.0, 0.0, 4.0, 2.0, 1.6, 0.0) for x in (10.0, 20.0, 30.0)])
    cars = Boxes.from_array(rows, "Car")
    seen = Boxes.from_array(rows[:found], "Car", np.linspace(0.9, 0.5, 3)[:found])
    truths = [Asked(f"s{i // 2}", cars, Boxes.empty(), Boxes.empty()) for i in range(2 * SCENES)]
    return score_detections([seen] * len(truths), truths, ("Car",))


def saved(folder: Path, result: Evaluation) -> Path:
    folder.mkdir()
    testing._save_matches(folder / testing.MATCHES, result)
    return folder


def test_a_difference_is_that_of_the_evaluations_and_its_sign_is_after_minus_before(tmp_path: Path):
    few, many = evaluation(1), evaluation(3)
    before, after = saved(tmp_path / "few", few), saved(tmp_path / "many", many)
    gained = many.score().ap - few.score().ap
    assert gained > 0.5
    forth, back = testing.difference(before, after, seed=1), testing.difference(after, before, seed=1)
    assert forth["mean"] == pytest.approx(gained)
    assert back["mean"] == pytest.approx(-gained)
    assert forth["low"] > 0 > back["high"]
    assert testing.difference(after, after, seed=1) == {"mean": 0.0, "low": 0.0, "high": 0.0}


def test_scenes_come_back_with_the_matches(tmp_path: Path):
    folder = saved(tmp_path / "arm", evaluation(2))
    matches, scenes = testing._load_matches(folder / testing.MATCHES)
    assert scenes.tolist() == [f"s{i // 2}" for i in range(2 * SCENES)]
    assert matches.hit.sum() == 2 * len(scenes)
    assert matches.targets.sum() == 3 * len(scenes)
