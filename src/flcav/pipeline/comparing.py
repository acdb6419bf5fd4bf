"""Paired comparison of two runs, over all tests that both made on the same frames."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.config import InputError
from flcav.intervals import Estimate, mean_over_seeds
from flcav.perception.outcomes import Outcomes, difference
from flcav.perception.tasks import task_named
from flcav.pipeline.results import OUTCOMES, Run, Test
from flcav.pipeline.running import RESULTS, WORK, seed_folders
from flcav.verdicts import verdict

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
    difference: Estimate  # over scenes; over seeds where both runs have several
    verdict: str  # of the claim that the second is better


def compare(first: Path, second: Path) -> tuple[Compared, ...]:
    """Return the paired difference of every test that both runs made, over the seeds that both have.

    Its interval (95 %) is a bootstrap over scenes for one common seed, Student's t over seeds for several.
    Raises `InputError` where a folder holds no finished run, and where no test was made on the same frames by both.
    """
    folders = [seed_folders(folder) for folder in (first, second)]
    seeds = [seed for seed in folders[0] if seed in folders[1]]
    rows = [_of_seed(folders[0][seed], folders[1][seed], seed) for seed in seeds]
    common = [key for key in (rows[0] if rows else {}) if all(key in row for row in rows)]
    if not common:
        raise InputError(f"{first} and {second}: no test was made by both on the same frames, with the same seed")
    return tuple(_over_seeds(key, [row[key] for row in rows]) for key in common)


def _of_seed(first: Path, second: Path, seed: int) -> dict[Key, Compared]:
    runs = [Run.load(folder, RESULTS) for folder in (first, second)]
    tests: list[Mapping[Key, Test]] = [{_key(test): test for test in run.tested} for run in runs]
    found = {}
    for key in tests[0].keys() & tests[1].keys():
        places = [folder / WORK / own[key].step / OUTCOMES for folder, own in zip((first, second), tests, strict=True)]
        try:
            both = [Outcomes.load(path) for path in places]
            mean, low, high = difference(task_named(key[3]), both[0], both[1], seed)
        except InputError:
            continue
        found[key] = _compared(key, tests[0][key], tests[1][key], Estimate(mean, low, high))
    order = list(tests[0])
    return {key: found[key] for key in sorted(found, key=order.index)}


def _key(test: Test) -> Key:
    return test.arm, test.stage, test.region, test.task


def _compared(key: Key, first: Test, second: Test, change: Estimate) -> Compared:
    values = first.result.estimate.mean, second.result.estimate.mean
    return Compared(*key, second.result.measure, *values, change, verdict(change.low, change.high))


def _over_seeds(key: Key, rows: list[Compared]) -> Compared:
    if len(rows) == 1:
        return rows[0]
    change = mean_over_seeds([row.difference.mean for row in rows])
    first, second = float(np.mean([row.first for row in rows])), float(np.mean([row.second for row in rows]))
    return Compared(*key, rows[0].measure, first, second, change, verdict(change.low, change.high))
