"""Failure search: how many distinct failures of a detector an adaptive search finds, against Sobol points.

All rules (`odd.searching.RULES`) test as many scenarios, and as many frames of each, in the same domain and towns with
the same detector. The rule "path" chooses frames as the search may, and learns nothing: it separates the two. Distinct
are failures in different cells of a grid (`odd.failures.GRID`).

Expected, before any run with these seeds: the search finds two to four times as many as Sobol points, and most of that
is from choosing frames in which there is somebody to miss; against such frames drawn at random it gains little.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.interface.progress import Report, ignore_progress
from flcav.odd.domain import read_domain
from flcav.odd.sampling import Space
from flcav.odd.scenery import Scenery
from flcav.odd.searching import RULES, Searched, distinct, search_failures
from flcav.perception.networks import resolve_network
from flcav.perception.objects.task import OBJECTS
from flcav.report import style
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.map.town import TOWNS, load_town

DOMAIN = "urban"
SCENARIOS, SEEDS = 60, 5
APART = 10_000  # between the seeds of two searches, which give their scenarios the seeds that follow
SOBOL, PATH, SEARCH = RULES
PAIRS = ((SEARCH, SOBOL), (SEARCH, PATH), (PATH, SOBOL))
NAMES: Mapping[str, str] = {
    SOBOL: "Sobol points",
    PATH: "Sobol points, somebody in the path",
    SEARCH: "search",
}


@dataclass(frozen=True)
class Found(Record):
    """Failures found by one search rule with one seed."""

    frames: int  # tested
    failing: int  # of them with a failure
    failures: int
    growth: tuple[int, ...]  # distinct failures after each scenario

    @property
    def distinct(self) -> int:
        """Return the number of distinct failures."""
        return self.growth[-1]


@dataclass(frozen=True)
class FailureSearchResult(Record):
    """Distinct failures of each rule, and their ratios, paired over seeds."""

    scenarios: int  # of each rule and seed
    found: Mapping[str, tuple[Found, ...]]  # by rule: one for each seed
    distinct: Mapping[str, MeanOverSeeds]  # by rule
    ratios: Mapping[str, Estimate]  # "failures / sobol", ...: geometric mean; interval by Student's t of logarithms
    together: Mapping[str, int]  # by rule: distinct failures of all seeds together
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the figures in words."""
        lines = [
            f"{rule}: {mean.describe()} distinct failures in {self.found[rule][0].frames} frames, "
            f"{self.together[rule]} of all seeds together"
            for rule, mean in self.distinct.items()
        ]
        return [*lines, *(f"{name}: {ratio.describe()}" for name, ratio in self.ratios.items())]

    def picture(self) -> bytes:
        """Return the growth of distinct failures with the frames as a PNG."""
        lines = {NAMES[rule]: np.array([each.growth for each in self.found[rule]]) for rule in RULES}
        return style.png(draw_growth(lines, self.found[SOBOL][0].frames / self.scenarios))


def compare_searches(
    out: Path, seeds: int = SEEDS, scenarios: int = SCENARIOS, progress: Report = ignore_progress
) -> FailureSearchResult:
    """Return what each rule finds with seeds 1, 2, ...; tested frames are kept in the folder `out`."""
    sceneries = [Scenery(load_town(name)) for name in TOWNS]
    space, network = Space(read_domain(DOMAIN), sceneries), resolve_network(OBJECTS, None, "cpu")
    searched: dict[str, list[list[Searched]]] = {rule: [] for rule in RULES}
    total, done = seeds * len(RULES) * scenarios, 0
    for seed in range(1, seeds + 1):
        for rule in RULES:

            def report(number: int, _: int, note: str, done: int = done, name: str = f"{rule}, seed {seed}") -> None:
                progress(done + number, total, f"{name}: {note}")

            kept = out / f"{rule}-{seed}.jsonl"
            searched[rule].append(search_failures(space, network, scenarios, APART * seed, rule, kept, report))
            done += scenarios
    return summarise(searched)


def summarise(searched: Mapping[str, Sequence[Sequence[Searched]]]) -> FailureSearchResult:
    """Return the figures of the searches by rule: one for each seed."""
    found = {rule: tuple(count(own) for own in every) for rule, every in searched.items()}
    every = {rule: set[tuple[str, ...]]().union(*map(distinct, own)) for rule, own in searched.items()}
    return FailureSearchResult(
        scenarios=len(next(iter(searched.values()))[0]),
        found=found,
        distinct={rule: mean_over_seeds([float(each.distinct) for each in own]) for rule, own in found.items()},
        ratios={f"{one} / {other}": mean_ratio(found[one], found[other]) for one, other in PAIRS},
        together={rule: len(cells) for rule, cells in every.items()},
        provenance=provenance(),
    )


def count(searched: Sequence[Searched]) -> Found:
    """Return the figures of one search."""
    frames = [frame for each in searched for frame in each.tested]
    return Found(
        frames=len(frames),
        failing=sum(bool(frame.failures) for frame in frames),
        failures=sum(len(frame.failures) for frame in frames),
        growth=tuple(len(distinct(searched[: number + 1])) for number in range(len(searched))),
    )


def mean_ratio(one: Sequence[Found], other: Sequence[Found]) -> Estimate:
    """Return the geometric mean over seeds of the ratio of distinct failures; none counts as one half."""
    ratios = [max(a.distinct, 0.5) / max(b.distinct, 0.5) for a, b in zip(one, other, strict=True)]
    logs = mean_over_seeds(np.log(ratios).tolist())
    low, high = (None if end is None else float(np.exp(end)) for end in (logs.low, logs.high))
    return Estimate(float(np.exp(logs.mean)), low, high)


def failure_search_tables(results: FailureSearchResult) -> dict[str, str]:
    """Return Markdown by name: found, ratios."""
    rows = []
    for rule, own in results.found.items():
        frames, failing, failures = (
            float(np.mean([getattr(each, name) for each in own])) for name in ("frames", "failing", "failures")
        )
        half = float(np.mean([each.growth[len(each.growth) // 2 - 1] for each in own]))
        mean = results.distinct[rule].describe()
        row = [f"{frames:.0f}", f"{failing:.1f}", f"{failures:.1f}", f"{half:.1f}", mean, str(results.together[rule])]
        rows.append([NAMES[rule], *row])
    columns = ("rule", "frames", "with a failure", "failures", "distinct after half", "distinct", "all seeds together")
    told = [
        [f"{NAMES[one]} / {NAMES[other]}", results.ratios[name].describe()]
        for name in results.ratios
        for one, other in [name.split(" / ")]
    ]
    return {
        "found": format_table(columns, rows),
        "ratios": format_table(("distinct failures", "ratio, interval"), told),
    }


COLOURS = (style.MUTED, style.BLUE, style.ORANGE)


@style.styled
def draw_growth(lines: Mapping[str, NDArray[np.int64]], frames: float) -> Figure:
    """Return distinct failures (seeds, scenarios) of each rule against tested frames, `frames` of each scenario."""
    figure = style.canvas(6.0, 3.4)
    axes = figure.subplots()
    for (name, found), colour in zip(lines.items(), COLOURS):
        at = frames * np.arange(1, found.shape[1] + 1)
        axes.plot(at, found.mean(axis=0), color=colour, label=name)
        axes.fill_between(at, found.min(axis=0), found.max(axis=0), color=colour, alpha=0.2, linewidth=0)
    axes.set(xlabel="frames tested", ylabel="distinct failures")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.grid(axis="y")
    style.key(figure, axes.get_lines())
    return figure


def _run(out: Path, options: Options) -> Outcome[FailureSearchResult]:
    with options.show_progress(options.title) as report:
        results = compare_searches(out, options.seeds, 4 if options.quick else SCENARIOS, report)
    return Outcome(results, {"growth.png": results.picture()}, results.sentences())


EXPERIMENT = Experiment(FailureSearchResult, _run, failure_search_tables, seeds=5, takes=("seeds", "scale"))
