"""Paired comparison of two runs, over all tests that both made on the same frames."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flcav.config import InputError
from flcav.runs.analysis.differences import compare_tests, mean_of_tests, mean_over_trainings
from flcav.runs.results.run import Run
from flcav.runs.results.tests import Test
from flcav.runs.running import WORK, seed_folders
from flcav.statistics.estimates import Estimate, combine_spreads, widen
from flcav.statistics.seeds import LARGEST_SPREAD, MeanOverSeeds, OneTraining, of_one_training
from flcav.statistics.verdicts import NOT_HELD, UNDECIDED, Claim, Judged, judge_known, tell_loss

Key = tuple[str, str, str, str]  # arm, stage, region, task


@dataclass(frozen=True)
class Compared:
    """Difference of a measure between two runs on the same frames: second minus first."""

    arm: str
    stage: str
    region: str
    task: str
    measure: str
    first: float  # value in the first run, in [0, 1] for AP and accuracy
    second: float  # value in the second run
    difference: Estimate  # over scenes and retraining; over seeds and scenes where both runs have several seeds
    verdict: str  # on the claim that the second is better, corrected for the number of tests
    judged: Judged | None = None  # the verdict with its p-value; None for one training of unknown spread


def compare(first: Path, second: Path) -> tuple[Compared, ...]:
    """Return the paired difference of every test that both runs made, over the seeds that both have.

    With several common seeds the 95 % interval is over seeds and scenes, of the mean over the trainings of a seed. With
    one it is over the trainings that both runs have. With one training it is a bootstrap over scenes, widened by the
    spread of retraining in both; if that is not known, only a loss that is too large for any spread is decided.
    Raises `InputError` where a folder holds no finished run, and where no test was made on the same frames by both.
    """
    folders = [seed_folders(folder) for folder in (first, second)]
    seeds = [seed for seed in folders[0] if seed in folders[1]]
    rows = [_of_seed(folders[0][seed], folders[1][seed], seed) for seed in seeds]
    common = [key for key in (rows[0] if rows else {}) if all(key in row for row in rows)]
    if not common:
        raise InputError(f"{first} and {second}: no test was made by both on the same frames, with the same seed")
    return _judge([rows[0][key] if len(rows) == 1 else _average(key, [row[key] for row in rows]) for key in common])


@dataclass(frozen=True)
class _Pair:
    compared: Compared
    folders: tuple[Path, Path]  # of the first training's tests, the second run's and the first's
    estimate: OneTraining | MeanOverSeeds | None  # what is judged; None for one training of unknown spread
    scenes: int  # of the test


def _of_seed(first: Path, second: Path, seed: int) -> dict[Key, _Pair]:
    runs = [Run.load(folder) for folder in (first, second)]
    tests: list[Mapping[Key, Test]] = [{test.key: test for test in run.tested} for run in runs]
    found = {}
    for key in (key for key in tests[0] if key in tests[1]):
        before, after = (made[key] for made in tests)
        with suppress(InputError):  # the tests are of different frames
            found[key] = _pair(key, before, after, (first / WORK, second / WORK), seed)
    return found


def _pair(key: Key, before: Test, after: Test, works: tuple[Path, Path], seed: int) -> _Pair:
    """Return the difference of two tests: in the mean of the trainings that both runs have, or of the first one."""
    folders = [(works[1] / new, works[0] / old) for new, old in zip(after.steps, before.steps, strict=False)]
    over_scenes = compare_tests(key[3], folders[0][1], folders[0][0], seed)
    measures = np.array([test.trainings[: len(folders)] for test in (before, after)])  # (2, trainings)
    values = (over_scenes.mean, *np.diff(measures, axis=0)[0, 1:])
    mean = mean_over_trainings(key[3], over_scenes, values, folders, seed, share=False)
    if mean is not None:
        change, known = mean.as_estimate(), mean
    else:
        spread = combine_spreads(before.spread, after.spread)
        measures = measures[:, :1]
        change = over_scenes if spread is None else widen(over_scenes, spread)
        known = None if spread is None else of_one_training(over_scenes, after.result.scenes, spread)
    first, second = measures.mean(axis=1).tolist()
    return _Pair(
        Compared(*key, after.result.measure, first, second, change, UNDECIDED), folders[0], known, after.result.scenes
    )


def _average(key: Key, pairs: Sequence[_Pair]) -> _Pair:
    """Return the mean over seeds of the difference in a test; its interval is over seeds and scenes."""
    compared = [pair.compared for pair in pairs]
    mean = mean_of_tests(
        key[3], [difference.difference.mean for difference in compared], [pair.folders for pair in pairs]
    )
    first, second = np.mean([(difference.first, difference.second) for difference in compared], axis=0).tolist()
    whole = replace(compared[0], first=first, second=second, difference=mean)
    return replace(pairs[0], compared=whole, estimate=mean)


def _judge(pairs: Sequence[_Pair]) -> tuple[Compared, ...]:
    """Judge all differences together; for one training of unknown spread only a large loss is decided."""
    judged = judge_known([None if pair.estimate is None else Claim(pair.estimate) for pair in pairs])
    return tuple(
        replace(pair.compared, verdict=_judge_unknown(pair, len(pairs)) if one is None else one.verdict, judged=one)
        for pair, one in zip(pairs, judged, strict=True)
    )


def _judge_unknown(pair: _Pair, family: int) -> str:
    """Return the verdict on one training of unknown spread: a loss that is too large for any spread of both runs."""
    # The difference of two trainings varies by sqrt(2) of the spread of one.
    lost = tell_loss(pair.compared.difference, pair.scenes, family, LARGEST_SPREAD * 2**0.5)
    return UNDECIDED if lost is None else NOT_HELD
