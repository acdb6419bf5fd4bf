"""Means over seeds from kept outcomes, where seeds have test scenes of their own and where they share them."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from flcav.perception.outcomes import Outcomes
from flcav.runs.analysis.summary import mean_of_tests
from flcav.runs.results.saved import OUTCOMES

SCENES, PICTURES = 10, 20


def save_test(folder: Path, names: list[str], right: np.ndarray) -> float:
    """Save a weather test of SCENES x PICTURES pictures, named rightly or not; return its accuracy."""
    folder.mkdir(parents=True)
    named = np.where(right.ravel(), 0, 1)
    Outcomes(np.repeat(names, PICTURES), {"truth": np.zeros_like(named), "named": named}).save(folder / OUTCOMES)
    return float(right.mean())


def test_scenes_that_seeds_share_widen_the_interval(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    hard = rng.uniform(0.5, 1.0, (SCENES, 1))  # the same scenes are hard for every seed
    tables = [rng.random((SCENES, PICTURES)) < hard for _ in range(3)]
    found = {}
    for kind in ("own", "shared"):
        folders, values = [], []
        for seed, right in enumerate(tables):
            names = [f"ring-{seed if kind == 'own' else 0}-{scene}" for scene in range(SCENES)]
            folders.append([tmp_path / kind / str(seed)])
            values.append(save_test(folders[-1][0], names, right))
        found[kind] = mean_of_tests("weather", values, folders, share=True)
        plain = mean_of_tests("weather", values, folders)
        theirs = stats.ttest_1samp(values, 0.0).confidence_interval()
        if kind == "own":
            assert (plain.low, plain.high) == pytest.approx((theirs.low, theirs.high))
    own, shared = found["own"], found["shared"]
    assert own.mean == shared.mean
    assert (own.shared.scenes, shared.shared.scenes) == (0, SCENES)
    assert shared.shared.sd == pytest.approx(hard.std(ddof=1) / np.sqrt(SCENES), rel=0.4)


def test_what_scenes_do_to_both_networks_cancels_in_their_difference(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    hard = rng.uniform(0.2, 1.0, (SCENES, 1))
    names, folders, values = [f"ring-0-{scene}" for scene in range(SCENES)], [], []
    for seed in range(3):
        before = rng.random((SCENES, PICTURES)) < hard
        after = before.copy()
        after[:, seed] = True  # one picture of every scene is named rightly after
        own = [tmp_path / str(seed) / name for name in ("after", "before")]
        values.append(save_test(own[0], names, after) - save_test(own[1], names, before))
        folders.append(own)
    found = mean_of_tests("weather", values, folders)
    single = mean_of_tests("weather", [0.0] * 3, [[own[1]] for own in folders])
    assert found.shared.sd < single.shared.sd / 4
    assert found.mean == pytest.approx(np.mean(values))
