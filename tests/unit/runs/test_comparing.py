"""Comparison of two finished runs with retrainings of their own, from kept outcomes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from test_run_recipe import parsed

from flcav.perception.outcomes import Outcomes
from flcav.runs.comparing import compare
from flcav.runs.provenance import Provenance
from flcav.runs.recipe import EDGE, MAIN
from flcav.runs.results import tests
from flcav.runs.results.run import Run
from flcav.runs.results.saved import OUTCOMES
from flcav.runs.running import RESULTS, WORK
from flcav.statistics.estimates import Estimate, Spread
from flcav.statistics.verdicts import HELD, UNDECIDED

SCENES, PICTURES = 10, 20
NAMES = np.repeat([f"ring-0-{scene}" for scene in range(SCENES)], PICTURES)


def save_run(folder: Path, wrong: Sequence[int], seed: int = 1) -> list[float]:
    """Save a run of one weather test; training n names `wrong[n]` pictures of each scene wrongly. Return accuracies."""
    truth, values = np.zeros(NAMES.size, dtype=np.int64), []
    for number, few in enumerate(wrong):
        named = np.tile(np.arange(PICTURES) < few, SCENES).astype(np.int64)
        place = folder / WORK / f"test-{number}"
        place.mkdir(parents=True)
        Outcomes(NAMES, {"truth": truth, "named": named}).save(place / OUTCOMES)
        values.append(1 - few / PICTURES)
    own = tests.Tested("ring", "weather", "accuracy", Estimate(values[0], values[0], values[0]), {}, NAMES.size, SCENES)
    steps = tuple(f"test-{number}" for number in range(1, len(wrong)))
    test = tests.Test(
        MAIN, EDGE, "ring", "weather", "test-0", own, own.estimate, Spread(0.01, 3), tuple(values[1:]), None, steps
    )
    made_by = Provenance(None, False, {}, "", 1, seed)
    Run(parsed(seed=seed), {}, (), (), (test,), (), (), {}, (), made_by).save(folder, RESULTS)
    return values


def test_the_trainings_that_both_runs_have_are_compared_in_their_mean(tmp_path: Path) -> None:
    first = save_run(tmp_path / "first", [10, 8, 9])
    second = save_run(tmp_path / "second", [5, 4, 6, 18])
    (row,) = compare(tmp_path / "first", tmp_path / "second")
    differences = np.subtract(second[:3], first)
    theirs = stats.ttest_1samp(differences, 0.0).confidence_interval()
    assert (row.first, row.second) == pytest.approx((np.mean(first), np.mean(second[:3])))
    assert row.difference.mean == pytest.approx(differences.mean())
    assert (row.difference.low, row.difference.high) == pytest.approx((theirs.low, theirs.high))
    assert row.verdict == HELD


def test_one_training_of_either_run_is_compared_with_the_first_of_the_other(tmp_path: Path) -> None:
    first = save_run(tmp_path / "first", [10, 8, 9])
    second = save_run(tmp_path / "second", [10])
    (row,) = compare(tmp_path / "first", tmp_path / "second")
    assert (row.first, row.second, row.difference.mean) == (first[0], second[0], 0.0)
    assert row.difference.low is not None
    assert row.difference.low < 0
    assert row.verdict == UNDECIDED


def test_a_seed_counts_with_the_mean_of_its_trainings(tmp_path: Path) -> None:
    kept = [
        [save_run(tmp_path / run / f"seed{seed}", wrong, seed) for seed, wrong in enumerate(rows)]
        for run, rows in {"first": ([10, 8], [9, 11]), "second": ([5, 5], [4, 8])}.items()
    ]
    (row,) = compare(tmp_path / "first", tmp_path / "second")
    differences = np.subtract(kept[1], kept[0]).mean(axis=1)
    assert row.difference.mean == pytest.approx(differences.mean())
    assert row.first == pytest.approx(np.mean(kept[0]))


def test_seeds_are_compared_with_themselves_and_only_those_that_both_have(tmp_path: Path) -> None:
    few = {"first": {1: 4, 2: 10, 3: 8}, "second": {2: 5, 3: 6, 4: 1}}
    kept = {
        (run, seed): save_run(tmp_path / run / f"seed{seed}", [wrong], seed)[0]
        for run, own in few.items()
        for seed, wrong in own.items()
    }
    (row,) = compare(tmp_path / "first", tmp_path / "second")
    differences = [kept["second", seed] - kept["first", seed] for seed in (2, 3)]
    theirs = stats.ttest_1samp(differences, 0.0).confidence_interval()
    assert row.difference.mean == pytest.approx(np.mean(differences))
    assert (row.difference.low, row.difference.high) == pytest.approx((theirs.low, theirs.high))
    assert (row.first, row.second) == pytest.approx((0.55, 0.725))
    assert row.judged is not None
    assert row.judged.p == pytest.approx(stats.ttest_1samp(differences, 0.0)[1])
