"""Comparison of lifelong learning with replay, without replay, and doing nothing: recipes/runs/lifelong.yaml.

Each seed has its own traffic, initial weights and test scenes, so that intervals over seeds cover training and scenes.
Arms of a seed share its frames, its pretrained network and the random draws of its rounds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.config import Json
from flcav.experiments.comparison import average_arms, mean_difference, tabulate_seeds
from flcav.experiments.experiment import Experiment, Options, Outcome, shrink_recipe
from flcav.report import style
from flcav.report.charts.lifelong import draw_conditions
from flcav.runs.extras.lifelong.rows import LifelongArm
from flcav.runs.extras.lifelong.settings import NOTHING, PLAIN, REPLAY
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import RunRecipe
from flcav.runs.results.run import Run
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import describe_means, tabulate_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record, select

TASK, MEASURE = "objects", "AP50"
ARMS = (REPLAY, PLAIN, NOTHING)
FINAL, BACKWARD = "final mean AP50", "backward transfer"
COMPARED = ((FINAL, REPLAY, NOTHING), (FINAL, REPLAY, PLAIN), (FINAL, PLAIN, NOTHING), (BACKWARD, REPLAY, PLAIN))


@dataclass(frozen=True)
class Mended(Record):
    """Counts of the conditions that an arm passed in all seeds, and of those where its network was mended."""

    passed: int
    broken: int  # conditions for which the network in use was not good enough when they came
    mended: int  # of these, those that got a network that was
    seconds: float | None  # median time from the condition's start until that network was in use; None without any


@dataclass(frozen=True)
class LifelongResult(Record):
    """Results of the comparison: arms by seed, means over seeds, and differences between arms."""

    conditions: tuple[str, ...]
    seeds: Mapping[str, Mapping[str, LifelongArm]]  # by seed and arm
    final: Mapping[str, MeanOverSeeds]  # AP50 in the mean of all conditions, after the last
    backward: Mapping[str, MeanOverSeeds]
    forward: Mapping[str, MeanOverSeeds]
    up_mb: Mapping[str, MeanOverSeeds]
    down_mb: Mapping[str, MeanOverSeeds]
    tested: Mapping[str, Mapping[str, tuple[MeanOverSeeds, ...]]]  # by condition and arm: pretrained, then after each
    mended: Mapping[str, Mended]
    differences: Mapping[str, MeanOverSeeds]
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return sentences: the scores and megabytes of each arm, and the verdicts on differences."""
        reached = [
            f"{arm}: {FINAL} {self.final[arm].describe()}, {BACKWARD} {self.backward[arm].describe(sign=True)}, "
            f"{self.up_mb[arm].mean:.1f} MB up, {counts.mended} of {counts.broken} mended"
            for arm, counts in self.mended.items()
        ]
        return [*reached, *describe_means(self.differences)]


def compare_lifelong(recipe: RunRecipe, runs: Sequence[Run]) -> LifelongResult:
    """Return the results of a run of each seed of `recipe`."""
    seeds = {
        str(run.recipe.seed): {result.arm: result for result in select(run.lifelong or (), task=TASK)} for run in runs
    }
    conditions = next(iter(seeds.values()))[NOTHING].conditions

    def mean_tested(arm: str, row: int, column: int) -> MeanOverSeeds:
        return average_arms(seeds, (arm,), lambda result: result.tested[row][column])[arm]

    return LifelongResult(
        conditions=conditions,
        seeds=seeds,
        final=average_arms(seeds, ARMS, _MEASURES[FINAL]),
        backward=average_arms(seeds, ARMS, _MEASURES[BACKWARD], share=False),
        forward=average_arms(seeds, ARMS, lambda result: result.forward, share=False),
        up_mb=average_arms(seeds, ARMS, lambda result: result.up_bytes / 1e6, share=False),
        down_mb=average_arms(seeds, ARMS, lambda result: result.down_bytes / 1e6, share=False),
        tested={
            condition: {arm: tuple(mean_tested(arm, row, column) for row in range(len(conditions) + 1)) for arm in ARMS}
            for column, condition in enumerate(conditions)
        },
        mended={arm: count_mended([seed[arm] for seed in seeds.values()]) for arm in ARMS},
        differences={
            f"{field}: {arm} - {other}": mean_difference(seeds, arm, other, _MEASURES[field])
            for field, arm, other in COMPARED
        },
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


_MEASURES: Mapping[str, Callable[[LifelongArm], float]] = {
    FINAL: lambda arm: arm.final,
    BACKWARD: lambda arm: arm.backward,
}


def count_mended(arms: Sequence[LifelongArm]) -> Mended:
    """Return the counts over an arm's results in all seeds."""
    seconds = [time_s for arm in arms for time_s in arm.mended]
    broken = sum(len(arm.broken) for arm in arms)
    median = float(np.median(seconds)) if seconds else None
    return Mended(sum(len(arm.passed) for arm in arms), broken, len(seconds), median)


def draw_lifelong(results: LifelongResult) -> bytes:
    """Return AP50 on each condition after each condition, a line per arm, as a PNG."""
    tested = {name: {arm: results.tested[name][arm] for arm in ARMS} for name in results.conditions}
    return style.png(draw_conditions(tested, MEASURE))


def lifelong_tables(results: LifelongResult) -> dict[str, str]:
    """Return Markdown by name: arms, conditions, differences, rounds, seeds."""
    return {
        "arms": _arms(results),
        "conditions": _conditions(results),
        "differences": tabulate_means("difference", results.differences),
        "rounds": _rounds(results),
        "seeds": tabulate_seeds(f"{FINAL}, {BACKWARD}", results.seeds, ARMS, tell_seed),
    }


def tell_seed(arm: LifelongArm) -> str:
    """Return the cell of the table by seed: final mean AP50 and backward transfer."""
    return f"{arm.final:.3f}, {arm.backward:+.3f}"


def _arms(results: LifelongResult) -> str:
    rows = []
    for arm in ARMS:
        counts_mended = results.mended[arm]
        seconds = "–" if counts_mended.seconds is None else f"{counts_mended.seconds:.0f}"
        moved = [results.backward[arm].describe(sign=True), results.forward[arm].describe(sign=True)]
        sent = [f"{results.up_mb[arm].mean:.1f}", f"{results.down_mb[arm].mean:.1f}"]
        counts = [f"{counts_mended.broken} of {counts_mended.passed}", f"{counts_mended.mended}", seconds]
        rows.append([arm, results.final[arm].describe(), *moved, *sent, *counts])
    titles = ("final mean AP50", "backward transfer", "forward transfer", "MB up", "MB down")
    return format_table(("arm", *titles, "conditions with errors", "mended", "median s until mended"), rows)


def _conditions(results: LifelongResult) -> str:
    rows = []
    for number, condition in enumerate(results.conditions):
        for arm in ARMS:
            means = results.tested[condition][arm]
            rows.append(
                [condition, arm, *(mean.describe() for mean in (means[0], means[number], means[number + 1], means[-1]))]
            )
    titles = ("pretrained", "before it came", "after it", "at the end")
    return format_table(("AP50 in", "arm", *titles), rows)


def _rounds(results: LifelongResult) -> str:
    rows = []
    for seed, arms in results.seeds.items():
        for arm in ARMS[:2]:
            for passed in arms[arm].passed:
                seconds = "–" if passed.mended_s is None else f"{passed.mended_s:.0f}"
                first, last = passed.scores[passed.condition][0], passed.scores[passed.condition][-1]
                cells = [
                    f"{first:.3f}",
                    f"{last:.3f}",
                    f"{passed.reachable:.3f}",
                    "yes" if passed.replaced else "no",
                    seconds,
                ]
                rows.append(
                    [
                        seed,
                        arm,
                        passed.condition,
                        f"{len(passed.asked)}",
                        f"{passed.members}",
                        f"{passed.rounds}",
                        *cells,
                    ]
                )
    titles = ("asked", "members", "rounds", "before", "after", "reachable", "new network drives", "s until mended")
    return format_table(("seed", "arm", "condition", *titles), rows)


def _run(out: Path, options: Options) -> Outcome[LifelongResult]:
    recipe = options.load("lifelong", shrink_recipe)
    runs = options.run_seeds(recipe, out)
    results = compare_lifelong(recipe, runs)
    return Outcome(results, {"lifelong.png": draw_lifelong(results)}, results.sentences())


EXPERIMENT = Experiment(LifelongResult, _run, lifelong_tables, seeds=5, recipe="lifelong")
