"""Redundant tasks: numbers in proportion to the complexity of scenarios against an even split, for equal uplink bytes.

The tasks of a scenario beyond its first are redundant: other vehicles with the same labels and network. All splits have
the same total number of tasks, and thus of updates by radio. The split by complexity is in proportion to the numbers
that the rule of `flcav.odd.scenario_tasks` gives the scenarios; in the reversed one, the least complex has the most.

Expected, before any run: the most complex scenario gains .01 to .03 AP50 by its further tasks, and the least complex
loses as much. The mean of the scenarios then changes by less than .01, which five seeds cannot distinguish from 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.experiments.study import record_split
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import Outcomes, Times, Values
from flcav.report import style
from flcav.report.charts.studies import Bar, precisions
from flcav.reproductions.redundant_tasks.scenarios import (
    EVEN,
    FULL,
    REVERSED,
    RULE,
    SPLITS,
    TOY,
    Size,
    TriedScenario,
    list_recordings,
    outcomes_file,
    try_splits,
)
from flcav.runs.engine import Notify, Step, run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.bootstrap import share_scenes
from flcav.statistics.seeds import OWN_SCENES, MeanOverSeeds, mean_over_seeds
from flcav.statistics.streams import stream
from flcav.statistics.verdicts import describe_means, tabulate_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record, from_json

PRETRAINED_ONLY = "pretrained, no tasks"
ALL, MOST, LEAST = "mean of the scenarios", "the most complex", "the least complex"
SCORES = (ALL, MOST, LEAST)


@dataclass(frozen=True)
class Weighed:
    """The outcomes of a scenario's network on test frames, and their weight in a score."""

    outcomes: Outcomes
    weight: float
    town: str


@dataclass(frozen=True)
class RedundantTasksResult(Record):
    """Accuracy of each split over seeds, and differences from the even split."""

    seeds: Mapping[str, tuple[TriedScenario, ...]]  # by seed, in descending order of complexity
    ap50: Mapping[str, Mapping[str, MeanOverSeeds]]  # by score and split
    differences: Mapping[str, MeanOverSeeds]  # from the even split, by "split - even split, score"
    up_mb: Mapping[str, float]  # uplink of all tasks by split, mean over seeds
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the uplink and the differences as sentences."""
        sent = ", ".join(f"{split} {mb:.2f} MB" for split, mb in self.up_mb.items())
        return [f"uplink: {sent}", *describe_means(self.differences)]

    def picture(self) -> bytes:
        """Return AP50 of each split by score, a dot per seed, as a PNG."""
        panels = {
            score: [Bar(split, mean.mean, self.scores_of(split, score)) for split, mean in by_split.items()]
            for score, by_split in self.ap50.items()
        }
        return style.png(precisions(panels, "AP50"))

    def scores_of(self, split: str, score: str) -> tuple[float, ...]:
        """Return the score of a split in each seed."""
        return tuple(
            sum(weight * scenario.ap50[str(count)] for scenario, count, weight in choose(tried, split, score))
            for tried in self.seeds.values()
        )


def compare_splits(
    out: Path, *, seeds: Sequence[int], quick: bool, jobs: int, notify: Notify, stale: str, engine: str
) -> RedundantTasksResult:
    """Run or finish the study in the folder `out`; `quick` is a smoke test of few frames and steps."""
    steps = list_steps(seeds, TOY if quick else FULL)
    values = run_steps(steps, out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    tried = {
        str(seed): from_json(tuple[TriedScenario, ...], values[name_step(seed)], name_step(seed)) for seed in seeds
    }
    return summarise(tried, {seed: out / name_step(int(seed)) for seed in tried})


def list_steps(seeds: Sequence[int], size: Size) -> list[Step]:
    """Return the steps: recordings, and the trainings and tests of each seed."""
    recordings = list_recordings(size)
    steps = [Step(name, record_split, {"recipe": fields}) for name, fields in recordings.items()]
    seed_steps = [Step(name_step(seed), try_splits, {"seed": seed, "size": size}, (*recordings,)) for seed in seeds]
    return [*steps, *seed_steps]


def name_step(seed: int) -> str:
    """Return the name of the step of a seed."""
    return f"seed{seed}"


def choose(tried: Sequence[TriedScenario], split: str, score: str) -> list[tuple[TriedScenario, int, float]]:
    """Return the scenarios of a score, each with its number of tasks in the split and its weight."""
    chosen = {ALL: tried, MOST: tried[:1], LEAST: tried[-1:]}[score]
    return [(scenario, scenario.tasks.get(split, 0), 1 / len(chosen)) for scenario in chosen]


def summarise(tried: Mapping[str, tuple[TriedScenario, ...]], folders: Mapping[str, Path]) -> RedundantTasksResult:
    """Return means over seeds, which share the test scenes; `folders`: of the outcomes, by seed."""

    def tests(seed: str, split: str, score: str, sign: float = 1.0) -> list[Weighed]:
        return [
            Weighed(
                Outcomes.load(outcomes_file(folders[seed], scenario.town, scenario.kind, count)),
                sign * weight,
                scenario.town,
            )
            for scenario, count, weight in choose(tried[seed], split, score)
        ]

    def accuracy(split: str, score: str) -> MeanOverSeeds:
        return mean_score([tests(seed, split, score) for seed in tried], share=True)

    def difference(split: str, score: str) -> MeanOverSeeds:
        return mean_score([[*tests(seed, split, score), *tests(seed, EVEN, score, -1.0)] for seed in tried])

    return RedundantTasksResult(
        seeds=tried,
        ap50={score: {split: accuracy(split, score) for split in (PRETRAINED_ONLY, *SPLITS)} for score in SCORES},
        differences={
            f"{split} - {EVEN}, {score}": difference(split, score) for split in (RULE, REVERSED) for score in SCORES
        },
        up_mb={
            split: float(
                np.mean(
                    [
                        sum(scenario.up_mb[str(scenario.tasks[split])] for scenario in scenarios)
                        for scenarios in tried.values()
                    ]
                )
            )
            for split in SPLITS
        },
        provenance=provenance(),
    )


def mean_score(seeds: Sequence[Sequence[Weighed]], *, share: bool = False) -> MeanOverSeeds:
    """Return the mean over seeds of a weighted sum of AP50; its interval covers the test scenes that seeds share."""
    values = [float(weigh_tests(tests, np.ones((1, count_frames(tests)), np.int64))[0]) for tests in seeds]
    if len(seeds) == 1:
        return mean_over_seeds(values, shared=OWN_SCENES, share=share)
    scenes = [[f"{test.town}/{scene}" for test in tests for scene in test.outcomes.scene] for tests in seeds]
    spread = share_scenes([partial(weigh_tests, tests) for tests in seeds], scenes, rng=stream(0, "scenes"))
    return mean_over_seeds(values, shared=spread, share=share)


def weigh_tests(tests: Sequence[Weighed], times: Times) -> Values:
    """Return (n,) the weighted sum of AP50, for each of n resamples of the frames of all tests, one after another."""
    ends = np.cumsum([len(test.outcomes.scene) for test in tests])
    parts: list[NDArray[np.int64]] = np.split(times, ends[:-1], axis=1)
    return sum(
        (test.weight * OBJECTS.measure(test.outcomes, part) for test, part in zip(tests, parts, strict=True)),
        np.zeros(len(times)),
    )


def count_frames(tests: Sequence[Weighed]) -> int:
    """Return the number of frames of all tests."""
    return sum(len(test.outcomes.scene) for test in tests)


def redundant_tasks_tables(results: RedundantTasksResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, differences, scenarios."""
    return {
        "accuracy": _accuracy(results),
        "differences": tabulate_means("AP50", results.differences),
        "scenarios": _scenarios(results),
    }


def _accuracy(results: RedundantTasksResult) -> str:
    splits = [*next(iter(results.ap50.values()))]
    rows = [
        [
            split,
            f"{results.up_mb[split]:.2f}" if split in results.up_mb else "0",
            *(by_split[split].describe() for by_split in results.ap50.values()),
        ]
        for split in splits
    ]
    return format_table(("tasks", "MB up", *(f"AP50, {score}" for score in results.ap50)), rows)


def _scenarios(results: RedundantTasksResult) -> str:
    names = dict.fromkeys(scenario.name for tried in results.seeds.values() for scenario in tried)
    rows = []
    for name in names:
        tries = [one for tried in results.seeds.values() for one in tried if one.name == name]
        complexity = float(np.mean([one.complexity.total for one in tries]))
        errors = float(np.mean([one.complexity.errors for one in tries]))
        by_rule = ", ".join(str(one.by_rule) for one in tries)
        shares = [f"{np.mean([one.tasks[split] for one in tries]):.1f}" for split in SPLITS]
        reached = [f"{np.mean([one.ap50[str(one.tasks[split])] for one in tries]):.3f}" for split in SPLITS]
        start = f"{np.mean([one.ap50['0'] for one in tries]):.3f}"
        cells = [f"{share} tasks: {ap}" for share, ap in zip(shares, reached, strict=True)]
        rows.append([name, f"{complexity:.2f}", f"{errors:.2f}", by_rule, start, *cells])
    heads = ("complexity", "of it errors", "tasks by the rule, by seed", "AP50, pretrained", *SPLITS)
    return format_table(("scenario", *heads), rows)


def _run(out: Path, options: Options) -> Outcome[RedundantTasksResult]:
    with options.show_steps(options.title) as notify:
        numbers = range(1, options.seeds + 1)
        results = compare_splits(out, seeds=numbers, quick=options.quick, **options.how(notify))
    return Outcome(results, {"splits.png": results.picture()}, results.sentences())


EXPERIMENT = Experiment(RedundantTasksResult, _run, redundant_tasks_tables, seeds=5)
