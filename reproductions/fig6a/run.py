"""Fig. 6a of Wang et al. (IEEE Network 37(3), 2023) in one table: what each scheme adds, from the committed results.

Nothing is trained. Studies differ in seeds, frames, networks and budgets, so that no level of one is beside that of
another: each row is a paired difference within one study, over its seeds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flcav.config import Json, read_json
from flcav.experiments import FOLDER
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.report import style
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.results.run import Summary
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.storage.markdown import format_table
from flcav.storage.records import Record, from_json

SCHEME, CONTROL = "scheme", "control"
Keys = tuple[str | int, ...]  # that lead to a value of a JSON object


@dataclass(frozen=True)
class Stored:
    """A difference that a study's result.json has."""

    keys: Keys

    def read(self, folder: Path) -> MeanOverSeeds:
        """Return it from the study's folder."""
        return from_json(MeanOverSeeds, _walk(read_json(folder / "result.json"), self.keys), str(folder))


@dataclass(frozen=True)
class Paired:
    """A difference of two numbers of each seed of a study's result.json."""

    after: Keys
    before: Keys

    def read(self, folder: Path) -> MeanOverSeeds:
        """Return its mean over the study's seeds."""
        result: Any = read_json(folder / "result.json")
        seeds = result["seeds"].values()
        return mean_over_seeds([_walk(seed, self.after) - _walk(seed, self.before) for seed in seeds])


@dataclass(frozen=True)
class Listed:
    """A difference that the summary of a run's seeds names."""

    name: str

    def read(self, folder: Path) -> MeanOverSeeds:
        """Return it from the folder of the seeds."""
        return next(each.estimate for each in Summary.load(folder).differences if each.name == self.name)


@dataclass(frozen=True)
class Step:
    """A row of the table: what is compared with what, and where its numbers are."""

    name: str
    kind: str  # `SCHEME` or `CONTROL`
    study: str  # folder of reproductions
    source: Stored | Paired | Listed


JOINED, TRACKS = "tracks and road labels, {} pole", "tracks, no road sensor"
STEPS = (
    Step(
        "edge FL - pretraining in the cloud",
        SCHEME,
        "runs/demo",
        Listed("grid and ring, objects: edge FL - pretrained"),
    ),
    Step(
        "edge FL - as many more steps of pretraining",
        CONTROL,
        "runs/demo",
        Listed("grid and ring, objects: edge FL - central training (more)"),
    ),
    Step(
        "centralised, 0.84 MB of annotated sweeps - edge FL, 7.1 MB",
        CONTROL,
        "megabytes",
        Paired(
            ("curves", "uploaded sweeps, four times the steps", -1, "ap50"),
            ("curves", "edge FL in int8, four times the steps", -1, "ap50"),
        ),
    ),
    Step(
        "edge FL on ground truth - on tracks",
        CONTROL,
        "gap",
        Stored(("differences", "edge FL on ground truth - edge FL on tracks")),
    ),
    Step(
        "densest pole - no road sensor",
        SCHEME,
        "distillation",
        Paired((JOINED.format("densest"), "ap50"), (TRACKS, "ap50")),
    ),
    Step(
        "VRCSP pole - no road sensor",
        SCHEME,
        "distillation",
        Paired((JOINED.format("VRCSP"), "ap50"), (TRACKS, "ap50")),
    ),
    Step(
        "VRCSP pole - densest pole",
        SCHEME,
        "distillation",
        Paired((JOINED.format("VRCSP"), "ap50"), (JOINED.format("densest"), "ap50")),
    ),
    Step("VRCSP pole - densest pole, fresh seeds", SCHEME, "pole_rules", Stored(("fresh",))),
    Step(
        "edge + cloud FL - edge FL, in grid",
        SCHEME,
        "runs/demo",
        Listed("grid, objects: edge + cloud FL - edge FL"),
    ),
    Step(
        "edge + cloud FL - edge FL, in ring",
        SCHEME,
        "runs/demo",
        Listed("ring, objects: edge + cloud FL - edge FL"),
    ),
    Step(
        "edge + cloud FL - as many more edge rounds, in grid",
        CONTROL,
        "demo_arms",
        Stored(("summary", "differences", "grid: edge + cloud FL - edge FL, as many more rounds")),
    ),
    Step(
        "joint plan (MLGRA) - equal stages, 180 MB + 110 MB",
        SCHEME,
        "fig6a_allocation",
        Stored(("budgets", 1, "summary", "realised_difference", "mean of towns", "cloud")),
    ),
    Step(
        "joint plan - equal stages, 80 MB + 20 MB, after edge FL",
        SCHEME,
        "runs/allocation_tracks",
        Listed("grid and ring, objects: edge FL - edge FL (equal)"),
    ),
    Step(
        "joint plan - equal stages, 80 MB + 20 MB, after cloud FL",
        SCHEME,
        "runs/allocation_tracks",
        Listed("grid and ring, objects: edge + cloud FL - edge + cloud FL (equal)"),
    ),
    Step(
        "two vehicles a round by importance - all",
        SCHEME,
        "federation/exchange",
        Stored(("differences", "importance, 2", "own region")),
    ),
    Step(
        "two vehicles a round by chance - all",
        CONTROL,
        "federation/exchange",
        Stored(("differences", "uniform, 2", "own region")),
    ),
    Step(
        "with stragglers, in equal seconds: those in time - all, who wait",
        SCHEME,
        "federation/stragglers",
        Stored(("primary",)),
    ),
    Step(
        "with stragglers, in equal seconds: importance of those in time - all, who wait",
        SCHEME,
        "federation/stragglers",
        Stored(("others", "vehicles alike: importance, 4 of those in time - all, waits")),
    ),
    Step(
        "with stragglers, in equal seconds: by chance - all, who wait",
        CONTROL,
        "federation/stragglers",
        Stored(("others", "vehicles alike: chance, 7 - all, waits")),
    ),
)


@dataclass(frozen=True)
class SchemesResult(Record):
    """The differences of all rows, by name."""

    differences: Mapping[str, MeanOverSeeds]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the differences in words."""
        return [f"{name}: {mean.describe(sign=True)}" for name, mean in self.differences.items()]


def _walk(value: Json, keys: Keys) -> Any:
    found: Any = value
    for key in keys:
        found = found[key]
    return found


def read_steps(reproductions: Path) -> SchemesResult:
    """Return the differences of all steps from the results in the folder of the reproductions."""
    return SchemesResult(
        {step.name: step.source.read(reproductions / step.study) for step in STEPS}, provenance=provenance()
    )


def tabulate_schemes(results: SchemesResult) -> dict[str, str]:
    """Return Markdown by name: schemes."""
    heads = ("difference", "kind", "mean, 95 % interval", "seeds", "study")
    rows = []
    for step in STEPS:
        mean = results.differences[step.name]
        link = f"[{step.study.rpartition('/')[2]}](../{step.study}/README.md)"
        rows.append([step.name, step.kind, mean.describe(sign=True), f"{mean.seeds} seeds", link])
    return {"schemes": format_table(heads, rows)}


@style.styled
def draw_schemes(results: SchemesResult) -> bytes:
    """Return all differences with their intervals as a PNG, schemes filled and controls hollow."""
    figure = style.canvas(9.6, 0.9 + 0.36 * len(STEPS))
    axes = figure.add_subplot()
    axes.axvline(0, color=style.MUTED, linewidth=1)
    for y, step in enumerate(STEPS):
        mean, colour = results.differences[step.name], style.BLUE if step.kind == SCHEME else style.ORANGE
        if mean.low is not None and mean.high is not None:
            axes.plot([mean.low, mean.high], [y, y], color=colour, linewidth=2)
        first = y == next(row for row, other in enumerate(STEPS) if other.kind == step.kind)
        axes.plot(mean.mean, y, "s", color=colour, markersize=6, label=step.kind if first else None)
    axes.set_yticks(range(len(STEPS)), [step.name for step in STEPS])
    axes.set_ylim(len(STEPS) - 0.5, -0.5)
    axes.grid(axis="x")
    axes.set_xlabel("difference, 95 % interval")
    style.key(figure, axes.get_legend_handles_labels()[0])
    return style.png(figure)


def _run(_: Path, __: Options) -> Outcome[SchemesResult]:
    results = read_steps(FOLDER)
    return Outcome(results, {"schemes.png": draw_schemes(results)}, results.sentences())


EXPERIMENT = Experiment(SchemesResult, _run, tabulate_schemes, seeds=1, takes=())
