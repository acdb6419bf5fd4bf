"""Comparison of labels for stage II, the arms of recipes/runs/distillation.yaml: same frames, steps and budget.

Arms differ only in their labels and the pole of these. Arms have separate ledgers, which include the boxes that their
vehicles send. Seeds have different recordings, so that intervals over them cover training and traffic. The verdicts on
all differences are corrected together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np

from flcav.config import Json
from flcav.experiments.comparison import average_arms, close_gap, compare_arms
from flcav.experiments.experiment import Experiment, Options, Outcome, shrink_recipe
from flcav.report import style
from flcav.report.charts import figures
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.training import LabelQuality
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import describe_means, tabulate_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record, select

TASK, TOWN = "objects", "grid"
PRETRAINED, TRACKS, JOINED, DENSEST, ROAD, AVERAGE, IDEAL = (
    "pretrained",
    "tracks, no road sensor",
    "tracks and road labels, VRCSP pole",
    "tracks and road labels, densest pole",
    "road labels, VRCSP pole",
    "road average, VRCSP pole",
    "ideal road labels, VRCSP pole",
)
ARMS: Mapping[str, tuple[str, str]] = {  # name in the tables -> arm, stage
    PRETRAINED: (MAIN, PRETRAIN),
    ROAD: ("road", EDGE),
    AVERAGE: ("average", EDGE),
    TRACKS: ("tracks", EDGE),
    DENSEST: ("densest", EDGE),
    JOINED: (MAIN, EDGE),
    IDEAL: ("ideal", EDGE),
}
COMPARED = (  # (after, before): claims that the difference is positive
    (JOINED, PRETRAINED),
    (JOINED, TRACKS),
    (JOINED, DENSEST),
    (JOINED, ROAD),
    (AVERAGE, TRACKS),
    (AVERAGE, ROAD),
    (IDEAL, JOINED),
)


@dataclass(frozen=True)
class DistillationArm:
    """Result of one arm in one seed."""

    ap50: float
    ap70: float
    up_mb: float  # wireless uplink of stage II [MB]: weights and boxes
    labels: tuple[LabelQuality, ...]  # before each round, or once if labels do not change; empty for the pretrained


@dataclass(frozen=True)
class DistillationResult(Record):
    """Results of the comparison: numbers by seed and arm, and means over seeds."""

    seeds: Mapping[str, Mapping[str, DistillationArm]]  # by seed and arm
    ap50: Mapping[str, MeanOverSeeds]  # by arm
    differences: Mapping[str, MeanOverSeeds]  # "after - before", in AP50
    closed: MeanOverSeeds  # gain of tracks without a road sensor, as a share of the gain with it
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return AP50 by arm, the verdicts on differences, and the share of the gain without a sensor, in words."""
        reached = [f"{arm}: AP50 {mean.describe()}" for arm, mean in self.ap50.items()]
        share = f"share of the gain with the road sensor that tracks bring without one: {self.closed.describe()}"
        return [*reached, *describe_means(self.differences), share]


def compare_labels(recipe: RunRecipe, runs: Sequence[Run]) -> DistillationResult:
    """Return the results of the arms of `recipe`, from a run of each seed."""
    seeds = {str(run.recipe.seed): {name: _reached(run, *arm) for name, arm in ARMS.items()} for run in runs}
    ap50 = attrgetter("ap50")
    return DistillationResult(
        seeds=seeds,
        ap50=average_arms(seeds, ARMS, ap50),
        differences=compare_arms(seeds, COMPARED, ap50),
        closed=close_gap(seeds, PRETRAINED, TRACKS, JOINED, ap50),
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def _reached(run: Run, arm: str, stage: str) -> DistillationArm:
    test = run.test(arm=arm, stage=stage, region=TOWN, task=TASK)
    ap70 = test.numbers["AP70"]
    assert ap70 is not None  # the town has targets
    if stage == PRETRAIN:
        return DistillationArm(test.estimate.mean, ap70, 0.0, ())
    (trained,) = select(run.arms[arm].stages, stage=stage, region=TOWN)
    sent = sum(spent.mb for spent in select(run.arms[arm].spent, stage=stage, link="wireless"))
    return DistillationArm(test.estimate.mean, ap70, sent, trained.labels or ())


def draw_labels(results: DistillationResult) -> bytes:
    """Return the forest plot of the AP50 of all arms as a PNG."""
    return style.png(figures.arms({TOWN: {name: results.ap50[name] for name in ARMS}}))


def tables(results: DistillationResult) -> dict[str, str]:
    """Return Markdown by name: arms, differences, labels."""
    return {
        "arms": _arms(results),
        "differences": tabulate_means("difference in AP50", results.differences),
        "labels": _labels(results),
    }


def _arms(results: DistillationResult) -> str:
    rows = []
    for name in ARMS:
        arms = [seed[name] for seed in results.seeds.values()]
        ap70 = float(np.mean([arm.ap70 for arm in arms]))
        sent = float(np.mean([arm.up_mb for arm in arms]))
        rows.append([name, results.ap50[name].describe(), f"{ap70:.3f}", f"{sent:.2f} MB" if sent else ""])
    return format_table(("stage II learns from", "AP50", "AP70, mean", "wireless uplink of stage II, mean"), rows)


def _labels(results: DistillationResult) -> str:
    """Return the mean precision and recall over seeds of the labels before the first and the last round."""
    rows = []
    for name in ARMS:
        if name == PRETRAINED:
            continue
        cells = []
        for place in (0, -1):
            labels = [seed[name].labels[place] for seed in results.seeds.values() if seed[name].labels]
            for field in ("precision", "recall"):
                known = [value for quality in labels if (value := getattr(quality, field)) is not None]
                cells.append(f"{np.mean(known):.3f}" if known else "")
        rows.append([name, *cells])
    at = (f"{name}, {when} round" for when in ("first", "last") for name in ("precision", "recall"))
    return format_table(("stage II learns from", *at), rows)


def _run(out: Path, options: Options) -> Outcome[DistillationResult]:
    recipe = options.load("distillation", shrink_recipe)
    runs = options.run_seeds(recipe, out)
    results = compare_labels(recipe, runs)
    return Outcome(results, {"arms.png": draw_labels(results)}, results.sentences())


EXPERIMENT = Experiment(DistillationResult, _run, tables, recipe="distillation")
