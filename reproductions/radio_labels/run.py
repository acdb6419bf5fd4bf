"""Comparison of label sources with and without vehicles' messages and a road sensor: recipes/runs/radio_labels.yaml.

Each source of labels is measured by the share of what ground truth gains that edge FL on it gains. Every seed has its
own recordings, so that intervals over seeds cover training and traffic. All aims are tested together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from flcav.config import Json
from flcav.experiments.comparison import average_arms, close_gap, mean_difference, tabulate_seeds
from flcav.experiments.experiment import Experiment, Options, Outcome, shrink_recipe
from flcav.report import style
from flcav.report.charts import figures
from flcav.reproductions.gap.run import GapArm, read_arm
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

TOWN = "grid"
PRETRAINED, TRACKS, HEARD, ROAD, ALL, TRUTH = (
    "pretrained",
    "tracks",
    "tracks and messages",
    "road labels and tracks",
    "road labels, tracks and messages",
    "ground truth",
)
ARMS: Mapping[str, tuple[str, str]] = {  # name in the tables -> arm, stage
    PRETRAINED: (MAIN, PRETRAIN),
    TRACKS: ("tracks", EDGE),
    HEARD: ("heard", EDGE),
    ROAD: ("road", EDGE),
    ALL: (MAIN, EDGE),
    TRUTH: ("truth", EDGE),
}
LABELLED = (TRACKS, HEARD, ROAD, ALL)


@dataclass(frozen=True)
class RadioLabelsResult(Record):
    """Results of the comparison: numbers by seed and arm, and means over seeds."""

    seeds: Mapping[str, Mapping[str, GapArm]]  # by seed and arm, in the town that federates
    ap50: Mapping[str, MeanOverSeeds]  # by arm
    ap70: Mapping[str, MeanOverSeeds]
    closed50: Mapping[str, MeanOverSeeds]  # share of what ground truth gains in AP50
    closed70: Mapping[str, MeanOverSeeds]
    precision: Mapping[str, MeanOverSeeds]  # of the labels; without arms that have none in a seed
    recall: Mapping[str, MeanOverSeeds]
    differences: Mapping[str, MeanOverSeeds]  # in AP50: what messages add, and what the road sensor adds to them
    recipe: Mapping[str, Json]
    provenance: Provenance

    def claims(self) -> dict[str, Claim]:
        """Return the aims of messages beside tracks, by name."""
        quality = {"recall of 0.80": (self.recall, 0.8), "precision of 0.90": (self.precision, 0.9)}
        return {
            **{f"labels' {aim}": Claim(of[HEARD], than=least) for aim, (of, least) in quality.items() if HEARD in of},
            "0.8 of what ground truth gains in AP50": Claim(self.closed50[HEARD], than=0.8),
            "messages add to tracks in AP50": Claim(self.differences[f"{HEARD} - {TRACKS}"]),
            "the road sensor adds 0.01 in AP50 to tracks and messages": Claim(
                self.differences[f"{ALL} - {HEARD}"], than=0.01
            ),
        }

    def sentences(self) -> list[str]:
        """Return the verdicts on the aims, in words."""
        return describe_aims(self.claims())


def compare_labels(recipe: RunRecipe, runs: Sequence[Run]) -> RadioLabelsResult:
    """Return the results of the arms of `recipe`, from a run of each seed."""
    seeds = {str(run.recipe.seed): {name: read_arm(run, *arm, TOWN) for name, arm in ARMS.items()} for run in runs}
    ap50, ap70 = attrgetter("ap50"), attrgetter("ap70")
    known = [name for name in LABELLED if None not in [seed[name].precision for seed in seeds.values()]]
    return RadioLabelsResult(
        seeds=seeds,
        ap50=average_arms(seeds, ARMS, ap50),
        ap70=average_arms(seeds, ARMS, ap70),
        closed50={arm: close_gap(seeds, PRETRAINED, arm, TRUTH, ap50) for arm in LABELLED},
        closed70={arm: close_gap(seeds, PRETRAINED, arm, TRUTH, ap70) for arm in LABELLED},
        precision=average_arms(seeds, known, attrgetter("precision")),
        recall=average_arms(seeds, known, attrgetter("recall")),
        differences={
            f"{after} - {before}": mean_difference(seeds, after, before, ap50)
            for after, before in ((HEARD, TRACKS), (ALL, HEARD))
        },
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def tabulate_labels(results: RadioLabelsResult) -> dict[str, str]:
    """Return Markdown by name: labels, aims, seeds."""
    means = (results.precision, results.recall, results.ap50, results.closed50, results.ap70, results.closed70)
    share = "share of the gain of truth"
    heads = ("edge FL on", "labels' precision", "labels' recall", "AP50", share, "AP70", share)
    rows = [[arm, *(of[arm].describe() if arm in of else "" for of in means)] for arm in ARMS]
    return {
        "labels": format_table(heads, rows),
        "aims": "\n".join(f"- {sentence}" for sentence in results.sentences()),
        "seeds": tabulate_seeds("AP50, AP70", results.seeds, ARMS, lambda arm: f"{arm.ap50:.3f}, {arm.ap70:.3f}"),
    }


def _run(out: Path, options: Options) -> Outcome[RadioLabelsResult]:
    recipe = options.load("radio_labels", shrink_recipe)
    results = compare_labels(recipe, options.run_seeds(recipe, out))
    picture = draw_labels(results)
    return Outcome(results, {"arms.png": picture}, results.sentences())


def draw_labels(results: RadioLabelsResult) -> bytes:
    """Return the forest plot of AP50 by arm as a PNG."""
    return style.png(figures.arms({TOWN: {name: results.ap50[name] for name in ARMS}}))


EXPERIMENT = Experiment(RadioLabelsResult, _run, tabulate_labels, seeds=5, recipe="radio_labels")
