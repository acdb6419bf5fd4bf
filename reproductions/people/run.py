"""Comparison of label sources for cars, pedestrians and cyclists in one federation: recipes/runs/people.yaml.

Every seed has its own recordings, so that intervals over seeds cover training and traffic. All claims are corrected
together.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flcav.config import Json
from flcav.experiments.comparison import mean_difference, tabulate_seeds
from flcav.experiments.experiment import Experiment, Options, Outcome, shrink_recipe
from flcav.report import style
from flcav.report.charts import figures
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.training import ClassLabels
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_table
from flcav.storage.records import Record, select

TOWN, TASK = "arterial", "objects"
PRETRAINED, TRACKS, HEARD, TRUTH = "pretrained", "tracks", "tracks and messages", "ground truth"
ARMS: Mapping[str, tuple[str, str]] = {  # name in the tables -> arm, stage
    PRETRAINED: (MAIN, PRETRAIN),
    TRACKS: (MAIN, EDGE),
    HEARD: ("heard", EDGE),
    TRUTH: ("truth", EDGE),
}
CLASSES: Mapping[str, str] = {"Car": "cars", "Pedestrian": "pedestrians", "Cyclist": "cyclists"}


@dataclass(frozen=True)
class ArmByClass:
    """AP in 3D at IoU 0.5 of each class after an arm, and its labels before the first round."""

    ap50: Mapping[str, float]
    labels: Mapping[str, ClassLabels]  # empty of the pretrained network


@dataclass(frozen=True)
class PeopleResult(Record):
    """Results of the comparison: numbers by seed and arm, and means over seeds by class."""

    seeds: Mapping[str, Mapping[str, ArmByClass]]  # by seed and arm, in the town that federates
    ap50: Mapping[str, Mapping[str, MeanOverSeeds]]  # by class and arm
    precision: Mapping[str, Mapping[str, MeanOverSeeds]]  # of labels, by class and arm; none where a seed has no label
    recall: Mapping[str, Mapping[str, MeanOverSeeds]]
    differences: Mapping[str, Mapping[str, MeanOverSeeds]]  # in AP50, by class and pair of arms
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the verdicts on what edge FL and messages add to each class, in words."""
        return describe_aims(
            {
                f"{CLASSES[kind]}, {pair}": Claim(mean)
                for kind, pairs in self.differences.items()
                for pair, mean in pairs.items()
            }
        )


def compare_classes(recipe: RunRecipe, runs: Sequence[Run]) -> PeopleResult:
    """Return the results of the arms of `recipe` by class, from a run of each seed."""
    seeds = {str(run.recipe.seed): {name: _read_arm(run, *arm) for name, arm in ARMS.items()} for run in runs}
    pairs = ((TRACKS, PRETRAINED), (HEARD, TRACKS), (TRUTH, HEARD))

    def average(kind: str, value: Callable[[ClassLabels], float | None]) -> dict[str, MeanOverSeeds]:
        by_arm = {arm: [value(e[arm].labels[kind]) for e in seeds.values()] for arm in (TRACKS, HEARD)}
        known = {arm: [share for share in shares if share is not None] for arm, shares in by_arm.items()}
        return {arm: mean_over_seeds(found, share=True) for arm, found in known.items() if len(found) == len(seeds)}

    return PeopleResult(
        seeds=seeds,
        ap50={
            kind: {arm: mean_over_seeds([e[arm].ap50[kind] for e in seeds.values()], share=True) for arm in ARMS}
            for kind in CLASSES
        },
        precision={kind: average(kind, lambda of: of.right / of.labels if of.labels else None) for kind in CLASSES},
        recall={kind: average(kind, lambda of: of.right / of.targets if of.targets else None) for kind in CLASSES},
        differences={
            kind: {f"{a} - {b}": mean_difference(seeds, a, b, lambda arm: arm.ap50[kind]) for a, b in pairs}  # noqa: B023
            for kind in CLASSES
        },
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def _read_arm(run: Run, arm: str, stage: str) -> ArmByClass:
    """Return what a run's arm reached for each class after a stage, and the labels that it learned from."""
    numbers = run.test(arm=arm, stage=stage, region=TOWN, task=TASK).numbers
    ap50 = {kind: numbers[f"AP50 {kind}"] or 0.0 for kind in CLASSES}
    stages = select(run.arms[arm].stages, stage=stage, region=TOWN) if stage == EDGE else ()
    labels = stages[0].labels if stages else None
    return ArmByClass(ap50, {of.name: of for of in (labels[0].by_class or ())} if labels else {})


def tabulate_classes(results: PeopleResult) -> dict[str, str]:
    """Return Markdown by name: classes, aims, seeds."""

    def describe(of: Mapping[str, Mapping[str, MeanOverSeeds]], kind: str, arm: str) -> str:
        return of[kind][arm].describe() if arm in of[kind] else ""

    columns = (results.precision, results.recall, results.ap50)
    heads = ("class", "edge FL on", "labels' precision", "labels' recall", "AP50")
    rows = [[CLASSES[kind], arm, *(describe(of, kind, arm) for of in columns)] for kind in CLASSES for arm in ARMS]
    title = f"AP50: {', '.join(CLASSES.values())}"
    return {
        "classes": format_table(heads, rows),
        "aims": "\n".join(f"- {sentence}" for sentence in results.sentences()),
        "seeds": tabulate_seeds(
            title, results.seeds, ARMS, lambda arm: ", ".join(f"{arm.ap50[kind]:.3f}" for kind in CLASSES)
        ),
    }


def _run(out: Path, options: Options) -> Outcome[PeopleResult]:
    recipe = options.load("people", shrink_recipe)
    results = compare_classes(recipe, options.run_seeds(recipe, out))
    return Outcome(results, {"arms.png": draw_people(results)}, results.sentences())


def draw_people(results: PeopleResult) -> bytes:
    """Return the forest plot of AP50 by arm, a panel per class, as a PNG."""
    ap50 = {CLASSES[kind]: {arm: results.ap50[kind][arm] for arm in ARMS} for kind in CLASSES}
    return style.png(figures.arms(ap50))


EXPERIMENT = Experiment(PeopleResult, _run, tabulate_classes, seeds=3, recipe="people")
