"""AP50 against megabytes, of weights in several forms and of compressed, annotated sweeps: recipes/runs/megabytes.yaml.

Edge FL and centralised training on uploaded sweeps take as many optimiser steps, at once and four times the local
steps. Sweeps that reach the AP50 of a federation are read off the curve of sweeps of its seed, in megabytes and in
annotated boxes.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from flcav.config import Json
from flcav.experiments.comparison import compare_arms, tabulate_seeds
from flcav.experiments.experiment import Experiment, Options, Outcome, list_works, shrink_recipe
from flcav.experiments.megabytes import (
    AtBytes,
    Curve,
    Curves,
    MeanAtBytes,
    average_curves,
    find_crossing,
    list_uploads,
    trace_federation,
    trace_pretrained,
    trace_uploads,
)
from flcav.network.ledger import Ledger
from flcav.perception.objects.samples import label_sweep
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import load_network
from flcav.report import style
from flcav.report.charts import figures
from flcav.runs.frames import Frames
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import EDGE, MAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.training.messages import choose_uploads
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import describe_means, tabulate_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

TASK, TOWN = "objects", "grid"
MORE = ", four times the steps"
SWEEPS = "uploaded sweeps"
FLOAT32, INT8, INT4, TOP_K = (f"edge FL in {form}" for form in ("float32", "int8", "int4", "top-k"))
SHOWN = (FLOAT32, INT8, INT4, TOP_K, INT8 + MORE, SWEEPS, SWEEPS + MORE)  # lines of the picture
REMEDIES: Mapping[str, str] = {  # against the drift of more local steps, by name: arm
    f"{INT8}{MORE}, server momentum": "momentum",
    f"{INT8}{MORE}, decaying rate": "decaying",
    f"{INT8}{MORE}, proximal term": "proximal",
}
FEDERATED: Mapping[str, str] = {  # name: arm
    FLOAT32: MAIN,
    INT8: "int8",
    INT4: "int4",
    TOP_K: "top_k",
    f"{INT8}{MORE}": "int8_fourfold",
    **REMEDIES,
}
COMPARED = (  # (after, before): claims that the difference in AP50 is positive
    (INT8, FLOAT32),
    (INT4, INT8),
    (TOP_K, INT8),
    (f"{INT8}{MORE}", INT8),
    *((remedy, f"{INT8}{MORE}") for remedy in REMEDIES),
)


@dataclass(frozen=True)
class SeedCurves:
    """Curves of a seed, and what its vehicles hold and its uploads take."""

    curves: Curves
    boxes: int  # annotated boxes in all sweeps of the vehicles
    bytes_per_return: float  # of the most sweeps that are uploaded, boxes included


@dataclass(frozen=True)
class Match:
    """The uploaded sweeps that reach the AP50 of a federation with as many optimiser steps."""

    ap50: MeanOverSeeds  # of the federation
    mb: float  # of its uplink
    sweeps_mb: tuple[float | None, ...]  # by seed; None: more than were uploaded
    sweeps_boxes: tuple[float | None, ...]  # likewise, annotated boxes


@dataclass(frozen=True)
class MegabytesResult(Record):
    """Results of the comparison: curves by seed and in the mean, differences, and sweeps that match federations."""

    seeds: Mapping[str, SeedCurves]
    curves: Mapping[str, tuple[MeanAtBytes, ...]]
    differences: Mapping[str, MeanOverSeeds]  # "after - before", in AP50 at the end
    matches: Mapping[str, Match]  # by federation
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the points of the mean curves, the matching sweeps and the verdicts, in words."""
        points = [
            f"{name}, {point.label}, {point.mb:.2f} MB: AP50 {point.ap50.describe()}"
            for name, curve in self.curves.items()
            for point in curve
        ]
        matches = [
            f"{name}, {match.mb:.2f} MB; megabytes of sweeps that reach it: {_span(match.sweeps_mb, '.2f')}; "
            f"their annotated boxes: {_span(match.sweeps_boxes, '.0f')}"
            for name, match in self.matches.items()
        ]
        return [*points, *matches, *describe_means(self.differences)]


def trace_seed(run: Run, work: Path) -> SeedCurves:
    """Return the curves of a run; `work` is the folder of its steps."""
    split = Frames.open(work / run.steps.recording(TOWN, EDGE, TASK))
    config = load_network(OBJECTS, work / run.steps.pretrain(MAIN, TASK) / WEIGHTS).config
    held = {frame: label_sweep(split.data.frame(frame), config) for frame in split.vehicles}
    pretrained = replace(trace_pretrained(run, TOWN), boxes=0)
    uploads = list_uploads(run.recipe)

    def sent(sweeps: int) -> list[int]:
        return list(choose_uploads({TOWN: split.vehicles}, sweeps, run.recipe.seed)[TOWN])

    def uploaded(more: bool) -> Iterator[AtBytes]:
        arms = [(arm, sweeps) for arm, sweeps in uploads if arm.endswith("_fourfold") == more]
        for (_, sweeps), point in zip(arms, trace_uploads(run, work, TOWN, arms), strict=True):
            yield replace(point, boxes=sum(len(held[frame].boxes) for frame in sent(sweeps)))

    curves: dict[str, Curve] = {
        name: (pretrained, *trace_federation(run, work, TOWN, arm)) for name, arm in FEDERATED.items()
    }
    arm, most = uploads[-1]
    book = Ledger.load(work / run.steps.central(arm, TOWN, TASK) / LEDGER)
    return SeedCurves(
        {**curves, **{f"{SWEEPS}{how}": (pretrained, *uploaded(bool(how))) for how in ("", MORE)}},
        sum(len(sample.boxes) for sample in held.values()),
        book.used_bytes("wireless") / sum(len(held[frame].points) for frame in sent(most)),
    )


def compare_megabytes(recipe: RunRecipe, seeds: Mapping[str, SeedCurves]) -> MegabytesResult:
    """Return the results of the arms of `recipe` from the curves of each seed."""
    curves = average_curves([seed.curves for seed in seeds.values()])
    ends = {name: {arm: curve[-1].ap50 for arm, curve in seed.curves.items()} for name, seed in seeds.items()}

    def match(name: str) -> Match:
        against = SWEEPS + (MORE if MORE in name else "")
        found = [_match(seed.curves[against], seed.curves[name][-1].ap50) for seed in seeds.values()]
        last = curves[name][-1]
        return Match(last.ap50, last.mb, *(tuple(side) for side in zip(*found, strict=True)))

    return MegabytesResult(
        seeds=seeds,
        curves=curves,
        differences=compare_arms(ends, COMPARED, float),
        matches={name: match(name) for name in FEDERATED},
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def _match(sweeps: Sequence[AtBytes], ap50: float) -> tuple[float | None, float | None]:
    """Return megabytes and annotated boxes at which a curve of sweeps reaches `ap50`; None where it does not."""
    return (
        find_crossing([(point.mb, point.ap50) for point in sweeps], ap50),
        find_crossing([(point.boxes or 0, point.ap50) for point in sweeps], ap50),
    )


def _span(values: Sequence[float | None], form: str) -> str:
    """Return the mean of the values of seeds, and their range."""
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return f"not reached in {len(values) - len(known)} of {len(values)} seeds"
    return f"{sum(known) / len(known):{form}} ({min(known):{form}} to {max(known):{form}})"


def _whole(value: float | None) -> str:
    return "" if value is None else f"{value:.0f}"


def megabytes_tables(results: MegabytesResult) -> dict[str, str]:
    """Return Markdown by name: curves, matches, differences, seeds."""
    curves = [
        [
            name,
            point.label,
            f"{point.mb:.2f}",
            "" if point.boxes is None else f"{point.boxes:.0f}",
            point.ap50.describe(),
        ]
        for name, curve in results.curves.items()
        for point in curve
        if point.mb or name.startswith(SWEEPS)
    ]
    matches = [
        [
            name,
            match.ap50.describe(),
            f"{match.mb:.2f}",
            _span(match.sweeps_mb, ".2f"),
            _span(match.sweeps_boxes, ".0f"),
        ]
        for name, match in results.matches.items()
    ]
    sizes = [[f"seed {name}", f"{seed.bytes_per_return:.2f}", seed.boxes] for name, seed in results.seeds.items()]
    ends = {name: {arm: curve[-1] for arm, curve in seed.curves.items()} for name, seed in results.seeds.items()}
    return {
        "curves": format_table(("training", "after", "uplink MB", "annotated boxes", "AP50"), curves),
        "matches": format_table(
            ("edge FL, ten rounds", "AP50", "uplink MB", "MB of sweeps that reach it", "their annotated boxes"), matches
        ),
        "differences": tabulate_means("difference in AP50", results.differences),
        "sizes": format_table(("", "bytes a return, boxes included", "annotated boxes of all vehicles"), sizes),
        "seeds": tabulate_seeds("AP50 at the end", ends, results.curves, lambda point: f"{point.ap50:.3f}"),
    }


def draw_megabytes(results: MegabytesResult) -> bytes:
    """Return AP50 against uplink megabytes and against annotated boxes, with the range over seeds, as a PNG.

    A federation on ground truth has the boxes of all sweeps of its vehicles. Remedies against drift are left out.
    """
    held = sum(seed.boxes for seed in results.seeds.values()) / len(results.seeds)
    sent, boxes = {}, {}
    for name in SHOWN:
        points = results.curves[name]
        reached = [[point.ap50 for point in seed.curves[name]] for seed in results.seeds.values()]
        ranges = [Estimate(sum(own) / len(own), min(own), max(own)) for own in zip(*reached, strict=True)]
        sent[name] = [(point.mb, ap50) for point, ap50 in zip(points[1:], ranges[1:], strict=True)]
        last = 1 if name.startswith(SWEEPS) else -1
        boxes[name] = [(point.boxes or held, own) for point, own in zip(points[last:], ranges[last:], strict=True)]
    costs = {"wireless uplink [MB]": sent, "annotated boxes": boxes}
    label = f"AP50 (mean and range of {len(results.seeds)} seeds)"
    return style.png(figures.by_costs(costs, results.curves[FLOAT32][0].ap50.mean, label))


def _run(out: Path, options: Options) -> Outcome[MegabytesResult]:
    recipe = options.load("megabytes", shrink_recipe)
    runs = options.run_seeds(recipe, out)
    seeds = {str(run.recipe.seed): trace_seed(run, work) for run, work in zip(runs, list_works(runs, out), strict=True)}
    results = compare_megabytes(recipe, seeds)
    return Outcome(results, {"megabytes.png": draw_megabytes(results)}, results.sentences())


EXPERIMENT = Experiment(MegabytesResult, _run, megabytes_tables, recipe="megabytes")
