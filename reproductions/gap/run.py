"""Comparison of federations and label sources by their share of what ground truth gains: recipes/runs/gap.yaml.

Stage II on ground truth is compared with centralised training on ground truth (*oracle*): the difference is the cost of
the federation, with its rates and steps. Ground truth with one fault of the tracks at a time shows the cost of each
fault. Networks are tested in the town that federates, and in the town of pretraining, where boxes may get worse. Each
seed has its own recordings, so that intervals over seeds cover training and traffic. The verdicts on all differences
are corrected together.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np

from flcav.config import Json
from flcav.experiments.comparison import average_arms, close_gap, compare_arms, mean_difference, tabulate_seeds
from flcav.experiments.experiment import Experiment, Options, Outcome, list_works, shrink_recipe
from flcav.experiments.megabytes import (
    AtBytes,
    Curves,
    MeanAtBytes,
    average_curves,
    list_uploads,
    trace_federation,
    trace_pretrained,
    trace_uploads,
)
from flcav.interface.wording import plural
from flcav.network.ledger import Ledger
from flcav.report import style
from flcav.report.charts import figures
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import describe_means, tabulate_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record, select

FEDERATED: Mapping[str, str] = {"edge FL on tracks": MAIN, "edge FL on ground truth": "truth"}  # by name: arm
IN_BYTES = "edge FL on ground truth, int8"
LONGER_ARMS = (("longer", EDGE), ("longer", MORE_EDGE), ("longest", MORE_EDGE))  # arms and stages of that curve
UPLOADED = "centralised on uploaded sweeps"


def trace_bytes(run: Run, work: Path, region: str) -> Curves:
    """Return AP50 against megabytes in one region of a run, by training; `work` is the folder of the run's steps.

    All curves begin with the pretrained network.
    """
    (task,) = run.recipe.tasks

    def in_bytes() -> Iterator[AtBytes]:
        for arm, stage in LONGER_ARMS:
            folder = work / run.steps.stage(arm, stage, region, task)
            number = sum(trained.rounds for trained in select(run.arms[arm].stages, stage=(EDGE, stage)))
            ap50 = run.test(arm=arm, stage=stage, region=region, task=task).estimate.mean
            yield AtBytes(plural(number, "round"), Ledger.load(folder / LEDGER).used_mb("wireless"), ap50)

    pretrained = trace_pretrained(run, region)
    curves = {name: (pretrained, *trace_federation(run, work, region, arm)) for name, arm in FEDERATED.items()}
    uploaded = (pretrained, *trace_uploads(run, work, region, list_uploads(run.recipe)))
    return {**curves, IN_BYTES: (pretrained, *in_bytes()), UPLOADED: uploaded}


TASK, TOWN, HOME = "objects", "grid", "suburb"
PRETRAINED, ORACLE = "pretrained", "centralised on ground truth"
JOINT, LONG_JOINT = (f"centralised on ground truth of both towns{how}" for how in ("", ", four times the steps"))
TRUTH, TWICE, FOURFOLD, COARSE, LONGER, LONGEST = (
    f"edge FL on ground truth{how}"
    for how in (
        "",
        ", twice the steps",
        ", four times the steps",
        ", int8",
        ", int8, twice the rounds",
        ", int8, four times the rounds",
    )
)
MISSED, UNSURE = "ground truth, missed objects background", "ground truth, missed objects neutral"
FAR, OCCLUDED = "ground truth, missed far objects background", "ground truth, missed occluded objects background"
FALSE, BOXES, PRESENCE = "ground truth, and false boxes", "ground truth, boxes of tracks", "ground truth, no boxes"
ROAD, TRACKS, JOINED = "edge FL on road labels", "edge FL on tracks", "edge FL on road labels and tracks"
GLOBAL, REPLAY, FROZEN, IMITATING, HALF, QUARTER = (
    f"edge + cloud FL on tracks{how}"
    for how in (
        "",
        ", with replay",
        ", head frozen",
        ", with imitation",
        ", half pretrained",
        ", three quarters pretrained",
    )
)
GLOBAL_TRUTH, QUARTER_TRUTH, GLOBAL_PRESENCE = (
    f"edge + cloud FL on ground truth{how}" for how in ("", ", three quarters pretrained", ", no boxes")
)
ARMS: Mapping[str, tuple[str, str]] = {  # name in the tables -> arm, stage
    PRETRAINED: (MAIN, PRETRAIN),
    ROAD: ("road", EDGE),
    TRACKS: (MAIN, EDGE),
    JOINED: ("joined", EDGE),
    MISSED: ("missed", EDGE),
    UNSURE: ("unsure", EDGE),
    FAR: ("range", EDGE),
    OCCLUDED: ("occlusion", EDGE),
    FALSE: ("false", EDGE),
    BOXES: ("boxes", EDGE),
    PRESENCE: ("presence", EDGE),
    TRUTH: ("truth", EDGE),
    TWICE: ("twice", EDGE),
    FOURFOLD: ("fourfold", EDGE),
    COARSE: ("longer", EDGE),
    LONGER: ("longer", MORE_EDGE),
    LONGEST: ("longest", MORE_EDGE),
    GLOBAL: ("bare", CLOUD),
    REPLAY: (MAIN, CLOUD),
    FROZEN: ("frozen", CLOUD),
    IMITATING: ("imitating", CLOUD),
    HALF: ("half", CLOUD),
    QUARTER: ("three_quarters", CLOUD),
    GLOBAL_TRUTH: ("truth", CLOUD),
    QUARTER_TRUTH: ("truth_three_quarters", CLOUD),
    GLOBAL_PRESENCE: ("presence", CLOUD),
    JOINT: ("joint", CENTRAL),
    LONG_JOINT: ("joint_fourfold", CENTRAL),
    ORACLE: ("oracle", CENTRAL),
}
PANELS: Mapping[str, tuple[str, ...]] = {  # of the picture
    "Labels of edge FL": (ROAD, TRACKS, JOINED, TRUTH),
    "Faults of labels": (MISSED, UNSURE, FAR, OCCLUDED, FALSE, BOXES, PRESENCE, TRUTH),
    "Steps, bytes and rounds": (TRUTH, TWICE, FOURFOLD, COARSE, LONGER, LONGEST),
    "One network for both towns": (
        *(GLOBAL, REPLAY, FROZEN, IMITATING, HALF, QUARTER),
        *(GLOBAL_TRUTH, QUARTER_TRUTH, GLOBAL_PRESENCE, JOINT, LONG_JOINT),
    ),
}
FOR_ALL = tuple(name for name, (_, stage) in ARMS.items() if stage in (PRETRAIN, CLOUD))
AT_HOME = (*FOR_ALL, JOINT, LONG_JOINT)  # one network for both towns: scored in that of pretraining, too
COMPARED = (  # (after, before): claims that the difference in AP50 is positive
    (TRUTH, PRETRAINED),
    (TRACKS, PRETRAINED),
    (TRACKS, ROAD),
    (JOINED, TRACKS),
    (TRUTH, TRACKS),
    (TRUTH, MISSED),
    (TRUTH, FAR),
    (TRUTH, OCCLUDED),
    (TRUTH, FALSE),
    (TRUTH, BOXES),
    (TRUTH, PRESENCE),
    (TWICE, TRUTH),
    (FOURFOLD, TWICE),
    (LONGER, COARSE),
    (LONGEST, LONGER),
    (ORACLE, TRUTH),
)


@dataclass(frozen=True)
class GapArm:
    """AP of an arm in one seed, and precision and recall of its labels."""

    ap50: float
    ap70: float
    precision: float | None  # of its labels; None of an arm without any
    recall: float | None


@dataclass(frozen=True)
class GapResult(Record):
    """Results of the comparison: numbers by seed and arm, and means over seeds."""

    seeds: Mapping[str, Mapping[str, GapArm]]  # by seed and arm, in the town that federates
    home: Mapping[str, Mapping[str, GapArm]]  # in the town of pretraining
    ap50: Mapping[str, MeanOverSeeds]  # by arm
    ap70: Mapping[str, MeanOverSeeds]
    closed50: Mapping[str, MeanOverSeeds]  # share of what edge FL on ground truth gains in AP50
    closed70: Mapping[str, MeanOverSeeds]
    differences: Mapping[str, MeanOverSeeds]  # "after - before", in AP50
    home50: Mapping[str, MeanOverSeeds]  # change in AP50 in the town of pretraining, by arm
    home70: Mapping[str, MeanOverSeeds]
    megabytes: Mapping[str, tuple[MeanAtBytes, ...]]  # AP50 against uplink megabytes, by curve
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return AP and share of the gap by arm, the verdicts on differences, and the change at home, in words."""
        reached = [
            f"{arm}: AP50 {mean.describe()}, of its gain on truth {self.closed50[arm].describe()}; "
            f"AP70 {self.ap70[arm].describe()}, of its gain on truth {self.closed70[arm].describe()}"
            for arm, mean in self.ap50.items()
        ]
        home = [
            f"at home, {name}: AP50 {mean.describe(sign=True)}, AP70 {self.home70[name].describe(sign=True)}"
            for name, mean in self.home50.items()
        ]
        at_bytes = [
            f"{name}, {point.label}, {point.mb:.1f} MB: AP50 {point.ap50.describe()}"
            for name, points in self.megabytes.items()
            for point in points
        ]
        return [*reached, *describe_means(self.differences), *home, *at_bytes]


def compare_gap(recipe: RunRecipe, runs: Sequence[Run], curves: Sequence[Curves]) -> GapResult:
    """Return the results of the arms of `recipe`, from a run of each seed and its `curves` of accuracy by bytes."""
    seeds = {str(run.recipe.seed): {name: read_arm(run, *ARMS[name], TOWN) for name in ARMS} for run in runs}
    home = {str(run.recipe.seed): {name: read_arm(run, *ARMS[name], HOME) for name in AT_HOME} for run in runs}

    ap50, ap70 = attrgetter("ap50"), attrgetter("ap70")
    return GapResult(
        seeds=seeds,
        home=home,
        ap50=average_arms(seeds, ARMS, ap50),
        ap70=average_arms(seeds, ARMS, ap70),
        closed50={arm: close_gap(seeds, PRETRAINED, arm, TRUTH, ap50) for arm in ARMS},
        closed70={arm: close_gap(seeds, PRETRAINED, arm, TRUTH, ap70) for arm in ARMS},
        differences=compare_arms(seeds, COMPARED, ap50),
        home50={arm: mean_difference(home, arm, PRETRAINED, ap50) for arm in AT_HOME[1:]},
        home70={arm: mean_difference(home, arm, PRETRAINED, ap70) for arm in AT_HOME[1:]},
        megabytes=average_curves(curves),
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def read_arm(run: Run, arm: str, stage: str, town: str) -> GapArm:
    """Return AP of an arm of a run after a stage, on the test frames of a town, and the quality of its labels."""
    test = run.test(arm=arm, stage=stage, region=town, task=TASK)
    ap70 = test.numbers["AP70"]
    assert ap70 is not None  # the town has targets
    stages = select(run.arms[arm].stages, stage=stage, region=TOWN)
    labels = stages[0].labels if stages and stage == EDGE else None
    quality = (labels[0].precision, labels[0].recall) if labels else (None, None)
    return GapArm(test.estimate.mean, ap70, *quality)


def draw_megabytes(results: GapResult) -> bytes:
    """Return AP50 against uplink megabytes, a line per curve, as a PNG."""
    lines = {name: [(point.mb, point.ap50) for point in points] for name, points in results.megabytes.items()}
    return style.png(figures.by_megabytes(lines))


def draw_gap(results: GapResult) -> bytes:
    """Return forest plots of the AP50 of all arms, a panel per question, as a PNG."""
    panels = {title: {name: results.ap50[name] for name in names} for title, names in PANELS.items()}
    marks = {name: results.ap50[name].mean for name in (PRETRAINED, ORACLE)}
    return style.png(figures.arms_by_question(panels, marks))


def gap_tables(results: GapResult) -> dict[str, str]:
    """Return Markdown by name: arms, differences, home, seeds."""
    return {
        "arms": _arms(results),
        "differences": tabulate_means("difference in AP50", results.differences),
        "home": _home(results),
        "megabytes": _megabytes(results),
        "seeds": tabulate_seeds("AP50, AP70", results.seeds, ARMS, lambda arm: f"{arm.ap50:.3f}, {arm.ap70:.3f}"),
    }


def _arms(results: GapResult) -> str:
    rows = []
    for name in ARMS:
        arms = [seed[name] for seed in results.seeds.values()]
        labels = (_mean([getattr(arm, field) for arm in arms]) for field in ("precision", "recall"))
        numbers = (results.ap50, results.closed50, results.ap70, results.closed70)
        rows.append([name, *(means[name].describe() for means in numbers), *labels])
    share = "share of the gain of truth"
    titles = ("arm", "AP50", share, "AP70", share, "labels' precision", "labels' recall")
    return format_table(titles, rows)


def _home(results: GapResult) -> str:
    rows = []
    for name in AT_HOME:
        arms = [seed[name] for seed in results.home.values()]
        row = [name]
        for field, change in (("ap50", results.home50), ("ap70", results.home70)):
            row += [
                _mean([getattr(arm, field) for arm in arms]),
                change[name].describe(sign=True) if name in change else "",
            ]
        rows.append(row)
    titles = ("AP50", "against pretrained", "AP70", "against pretrained")
    return format_table((f"in {HOME}", *titles), rows)


def _megabytes(results: GapResult) -> str:
    rows = [
        [name, point.label, f"{point.mb:.1f}", point.ap50.describe()]
        for name, points in results.megabytes.items()
        for point in points
    ]
    return format_table(("training", "after", "uplink MB", "AP50"), rows)


def _mean(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.3f}" if known else ""


def _run(out: Path, options: Options) -> Outcome[GapResult]:
    recipe = options.load("gap", shrink_recipe)
    runs = options.run_seeds(recipe, out)
    curves = [trace_bytes(run, work, TOWN) for run, work in zip(runs, list_works(runs, out), strict=True)]
    results = compare_gap(recipe, runs, curves)
    pictures = {"arms.png": draw_gap(results), "megabytes.png": draw_megabytes(results)}
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(GapResult, _run, gap_tables, recipe="gap")
