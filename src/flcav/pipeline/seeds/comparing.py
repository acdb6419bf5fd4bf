"""Paired comparison of two runs, over all tests that both made on the same frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flcav.config import InputError
from flcav.intervals import Estimate, OneTraining, combine_spreads, of_one_training, widen
from flcav.perception.outcomes import Outcomes, difference
from flcav.perception.tasks import task_named
from flcav.pipeline.collecting.tests import mean_of_tests
from flcav.pipeline.results.run import Run
from flcav.pipeline.results.saved import OUTCOMES
from flcav.pipeline.results.tests import Test
from flcav.pipeline.running import RESULTS, WORK, seed_folders
from flcav.verdicts import UNDECIDED, Claim, judge, judge_known

Key = tuple[str, str, str, str]  # arm, stage, region, task


@dataclass(frozen=True)
class Compared:
    """Difference of a measure between two runs on the same frames: second minus first."""

    arm: str
    stage: str
    region: str
    task: str
    measure: str
    first: float
    second: float
    difference: Estimate  # over scenes and retraining; over seeds and scenes where both runs have several seeds
    verdict: str  # of the claim that the second is better, corrected for the number of tests


def compare(first: Path, second: Path) -> tuple[Compared, ...]:
    """Return the paired difference of every test that both runs made, over the seeds that both have.

    Its interval (95 %) is a bootstrap over scenes for one common seed, widened by the spread of retraining in both
    runs; where that is not known, one seed decides nothing. For several seeds it is over seeds and scenes. Raises
    `InputError` where a folder holds no finished run, and where no test was made on the same frames by both.
    """
    folders = [seed_folders(folder) for folder in (first, second)]
    seeds = [seed for seed in folders[0] if seed in folders[1]]
    rows = [_of_seed(folders[0][seed], folders[1][seed], seed) for seed in seeds]
    common = [key for key in (rows[0] if rows else {}) if all(key in row for row in rows)]
    if not common:
        raise InputError(f"{first} and {second}: no test was made by both on the same frames, with the same seed")
    if len(rows) == 1:
        return _judge_trainings([rows[0][key] for key in common])
    means = [mean_of_tests(key[3], *_listed([row[key] for row in rows])) for key in common]
    judged = judge([Claim(mean) for mean in means])
    return tuple(
        _compared(key, [row[key].compared for row in rows], mean, one.verdict)
        for key, mean, one in zip(common, means, judged, strict=True)
    )


@dataclass(frozen=True)
class _Pair:
    compared: Compared  # of one seed
    folders: tuple[Path, Path]  # of the second run's test and of the first's
    training: OneTraining | None  # the difference of one training each; None where the spread is not known


def _of_seed(first: Path, second: Path, seed: int) -> dict[Key, _Pair]:
    runs = [Run.load(folder, RESULTS) for folder in (first, second)]
    tests: list[Mapping[Key, Test]] = [{_key(test): test for test in run.tested} for run in runs]
    found = {}
    for key in tests[0].keys() & tests[1].keys():
        places = [folder / WORK / own[key].step for folder, own in zip((first, second), tests, strict=True)]
        try:
            both = [Outcomes.load(path / OUTCOMES) for path in places]
            mean, low, high = difference(task_named(key[3]), both[0], both[1], seed)
        except InputError:
            continue
        before, after = (own[key].result for own in tests)
        values = before.estimate.mean, after.estimate.mean
        spread = combine_spreads(*(own[key].spread for own in tests))
        over_scenes = Estimate(mean, low, high)
        change = over_scenes if spread is None else widen(over_scenes, spread)
        training = None if spread is None else of_one_training(over_scenes, after.scenes, spread)
        one = Compared(*key, after.measure, *values, change, UNDECIDED)
        found[key] = _Pair(one, (places[1], places[0]), training)
    order = list(tests[0])
    return {key: found[key] for key in sorted(found, key=order.index)}


def _judge_trainings(pairs: Sequence[_Pair]) -> tuple[Compared, ...]:
    """Return the differences of one seed with their verdicts, judged together; unknown ones are undecided."""
    judged = judge_known([None if pair.training is None else Claim(pair.training) for pair in pairs])
    return tuple(
        pair.compared if one is None else replace(pair.compared, verdict=one.verdict)
        for pair, one in zip(pairs, judged, strict=True)
    )


def _key(test: Test) -> Key:
    return test.arm, test.stage, test.region, test.task


def _listed(pairs: Sequence[_Pair]) -> tuple[list[float], list[tuple[Path, Path]]]:
    """Return the difference and the folders of each seed."""
    return [pair.compared.difference.mean for pair in pairs], [pair.folders for pair in pairs]


def _compared(key: Key, rows: Sequence[Compared], change: Estimate, decided: str) -> Compared:
    first, second = float(np.mean([row.first for row in rows])), float(np.mean([row.second for row in rows]))
    return Compared(*key, rows[0].measure, first, second, change, decided)
