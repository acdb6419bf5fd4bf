"""Comparison of edge FL, edge + cloud FL, further edge FL and uploads on rare kinds: recipes/runs/corner_cases.yaml.

The article's premise is that the cloud transfers knowledge between regions. Rare kinds of cars occur in one region's
training data; in another region, and in an unseen town, they only occur in the test. AP of the rare kinds counts other
objects as neutral: a detection of them is neither true nor false. Labels are ground truth, so that only the transfer by
networks is measured. Seeds have different recordings, so that intervals over them cover training and traffic.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.config import Json
from flcav.experiments.comparison import average_arms, mean_difference
from flcav.experiments.experiment import Experiment, Options, Outcome, list_works, shrink_recipe
from flcav.geometry.boxes import Boxes, concatenate
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.agents import frame_reader
from flcav.perception.objects.evaluate import score_detections
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_frames
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import CARS, FrameTruth
from flcav.perception.weights import load_network
from flcav.report import style
from flcav.report.charts import figures
from flcav.runs.frames import Frames
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.saved import WEIGHTS
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import describe_means, tabulate_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.shapes import RARE, SHAPES

TASK, OWN, OTHER, UNSEEN = "objects", "grid", "ring", "arterial"
PRETRAINED, LOCAL, GLOBAL, LONGER = "pretrained", "edge FL", "edge + cloud FL", "further edge FL"
BORROWED, UPLOADED = f"edge FL of {OTHER}", f"centralised on sweeps of {OTHER}"


class Learned(NamedTuple):
    """Origin of a network: arm and stage of the run, and its region; None: the region of the test."""

    arm: str
    stage: str
    region: str | None = None


ARMS: Mapping[str, Learned] = {
    PRETRAINED: Learned(MAIN, PRETRAIN),
    LOCAL: Learned(MAIN, EDGE),
    GLOBAL: Learned(MAIN, CLOUD),
    LONGER: Learned("longer", MORE_EDGE),
    BORROWED: Learned(MAIN, EDGE, OTHER),
    UPLOADED: Learned("sweeps", CENTRAL, OTHER),
}
TOWNS: Mapping[str, tuple[str, ...]] = {  # tested arms by town; the unseen one does not federate
    OWN: (*ARMS,),
    OTHER: (PRETRAINED, LOCAL, GLOBAL, LONGER, UPLOADED),
    UNSEEN: (PRETRAINED, GLOBAL, BORROWED, UPLOADED),
}
COMPARED = (  # town, after, before, objects
    (OTHER, LOCAL, PRETRAINED, "rare"),
    (OWN, GLOBAL, LOCAL, "rare"),
    (OWN, GLOBAL, LONGER, "rare"),
    (OWN, GLOBAL, LOCAL, "every"),
    (OTHER, GLOBAL, LOCAL, "rare"),
    (UNSEEN, GLOBAL, PRETRAINED, "rare"),
    (OTHER, UPLOADED, GLOBAL, "rare"),
    (OWN, UPLOADED, GLOBAL, "rare"),
)
SIZES = np.array([shape[1:] for kind in CARS for shape in SHAPES[kind] if shape.name in RARE])
NEAR_M = 0.005  # tolerance of sizes, which are those of the shapes


@dataclass(frozen=True)
class RareScore:
    """AP50 of a network on all objects and on rare kinds only, and the number of rare targets."""

    every: float
    rare: float
    targets: int


@dataclass(frozen=True)
class CornerCaseResult(Record):
    """Results of the comparison: scores by seed, town and arm, and means over seeds."""

    seeds: Mapping[str, Mapping[str, Mapping[str, RareScore]]]  # by seed, town and arm
    rare: Mapping[str, Mapping[str, MeanOverSeeds]]  # AP50 of the rare kinds, by town and arm
    every: Mapping[str, Mapping[str, MeanOverSeeds]]  # of all objects
    differences: Mapping[str, MeanOverSeeds]
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return AP by town and arm, and the verdicts on differences, in words."""
        reached = [
            f"{town}, {arm}: AP50 of rare kinds {mean.describe()}, of all objects {self.every[town][arm].describe()}"
            for town, arms in self.rare.items()
            for arm, mean in arms.items()
        ]
        return [*reached, *describe_means(self.differences)]


def compare_corner_cases(
    recipe: RunRecipe, runs: Sequence[Run], works: Sequence[Path], progress: Report = ignore_progress
) -> CornerCaseResult:
    """Return the results of the arms of `recipe` from a run per seed, with their steps in the folders `works`."""
    seeds: dict[str, dict[str, dict[str, RareScore]]] = {}
    for number, (run, work) in enumerate(zip(runs, works, strict=True), start=1):
        seeds[str(run.recipe.seed)] = {
            town: {arm: score_arm(run, work, arm, town) for arm in arms} for town, arms in TOWNS.items()
        }
        progress(number, len(runs), "")
    by_town = {town: {seed: scores[town] for seed, scores in seeds.items()} for town in TOWNS}

    def gain(town: str, after: str, before: str, field: str) -> MeanOverSeeds:
        return mean_difference(by_town[town], after, before, attrgetter(field))

    objects = {"rare": "rare kinds", "every": "all objects"}
    return CornerCaseResult(
        seeds=seeds,
        rare={town: average_arms(by_town[town], arms, attrgetter("rare")) for town, arms in TOWNS.items()},
        every={town: average_arms(by_town[town], arms, attrgetter("every")) for town, arms in TOWNS.items()},
        differences={f"{row[0]}, {objects[row[3]]}: {row[1]} - {row[2]}": gain(*row) for row in COMPARED},
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def score_arm(run: Run, work: Path, arm: str, town: str) -> RareScore:
    """Return the scores of an arm's network on a town's test frames."""
    learned = ARMS[arm]
    step = run.steps.stage(learned.arm, learned.stage, learned.region or town, TASK)
    network = load_network(OBJECTS, work / step / WEIGHTS)
    return score_rare(network, Frames.open(work / run.steps.recording(town, "test", TASK)))


def score_rare(network: Second, split: Frames) -> RareScore:
    """Return the scores of a network on the vehicles' frames of a split."""
    read = frame_reader(split.data, network.config.foreground)
    detections, truths = detect_frames(network, map(read, split.vehicles), None, total=len(split.vehicles))
    rare = [only_rare(truth) for truth in truths]
    every, alone = (_ap50(detections, targets, network.config.classes) for targets in (truths, rare))
    return RareScore(every, alone, sum(len(truth.targets) for truth in rare))


def _ap50(detections: Sequence[Boxes], truths: Sequence[FrameTruth], classes: tuple[str, ...]) -> float:
    scores = score_detections(detections, truths, classes)
    (ap,) = (row.ap for row in scores if (row.kind, row.iou, row.label) == ("3d", 0.5, "Car"))
    return 0.0 if ap is None else ap


def only_rare(truth: FrameTruth) -> FrameTruth:
    """Return the ground truth with only rare kinds as targets; all other targets become neutral."""
    kept = is_rare(truth.targets)
    neutral = concatenate([truth.neutral, truth.targets[~kept]])
    return replace(truth, targets=truth.targets[kept], neutral=neutral, occlusion=None)


def is_rare(boxes: Boxes) -> NDArray[np.bool_]:
    """Return a mask (N,) of the annotated boxes with the size of a rare kind."""
    apart = np.abs(boxes.size[:, None] - SIZES).max(axis=2)
    return (apart < NEAR_M).any(axis=1)


def draw_corner_cases(results: CornerCaseResult) -> bytes:
    """Return the forest plot of the AP50 of rare kinds, a panel per town, as a PNG."""
    towns = {town: {name: results.rare[town][name] for name in names} for town, names in TOWNS.items()}
    return style.png(figures.arms(towns, "AP50 of rare kinds"))


def corner_case_tables(results: CornerCaseResult) -> dict[str, str]:
    """Return Markdown by name: scores, differences, seeds."""
    return {
        "scores": _scores(results),
        "differences": tabulate_means("difference in AP50", results.differences),
        "seeds": _seeds(results),
    }


def _scores(results: CornerCaseResult) -> str:
    rows = []
    for town, arms in TOWNS.items():
        for arm in arms:
            targets = np.mean([seed[town][arm].targets for seed in results.seeds.values()])
            means = (results.rare[town][arm].describe(), results.every[town][arm].describe())
            rows.append([town, arm, *means, f"{targets:.0f}"])
    return format_table(("town", "arm", "AP50 of rare kinds", "AP50 of all objects", "rare targets a seed"), rows)


def _seeds(results: CornerCaseResult) -> str:
    rows = [
        [
            f"{town}, {arm}",
            *(f"{seed[town][arm].rare:.3f}, {seed[town][arm].every:.3f}" for seed in results.seeds.values()),
        ]
        for town, arms in TOWNS.items()
        for arm in arms
    ]
    return format_table(("AP50 of rare kinds, of all", *(f"seed {seed}" for seed in results.seeds)), rows)


def _run(out: Path, options: Options) -> Outcome[CornerCaseResult]:
    recipe = options.load("corner_cases", shrink_recipe)
    runs = options.run_seeds(recipe, out)
    with options.show_progress("rare kinds") as report:
        results = compare_corner_cases(recipe, runs, list_works(runs, out), report)
    return Outcome(results, {"arms.png": draw_corner_cases(results)}, results.sentences())


EXPERIMENT = Experiment(CornerCaseResult, _run, corner_case_tables, seeds=8, recipe="corner_cases")
