"""Failure search: distinct failures of a detector that an adaptive search finds, compared with Sobol points.

All rules (`odd.searching.RULES`) test equally many scenarios and frames, in the same domain and towns with the same
detector. The rule "path" draws from the same frames as the search, but does not learn: it separates the two effects.
Failures are distinct if they are in different cells of a grid (`odd.searching.GRID`).

Expected, before any run with these seeds: the search finds two to four times as many as Sobol points, mostly because it
chooses frames with road users to miss; compared with random frames of this kind it gains little.
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
APART = 10_000  # between the seeds of two searches, whose scenarios have consecutive seeds
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

    frames: int  # number of tested frames
    failing: int  # number of frames with a failure
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
    found: Mapping[str, tuple[Found, ...]]  # by rule and seed
    distinct: Mapping[str, MeanOverSeeds]  # by rule
    ratios: Mapping[str, Estimate]  # "failures / sobol", ...: geometric mean; interval by Student's t of logarithms
    together: Mapping[str, int]  # number of distinct failures in all seeds, by rule
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
        """Return the growth of distinct failures with tested frames as a PNG."""
        lines = {NAMES[rule]: np.array([search.growth for search in self.found[rule]]) for rule in RULES}
        return style.png(draw_growth(lines, self.found[SOBOL][0].frames / self.scenarios))


def compare_searches(
    out: Path, seeds: int = SEEDS, scenarios: int = SCENARIOS, progress: Report = ignore_progress
) -> FailureSearchResult:
    """Run the searches of all rules with seeds 1, 2, ..., and return their results; frames are kept in `out`."""
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
    """Return the results of searches, by rule and seed."""
    found = {rule: tuple(count(search) for search in searches) for rule, searches in searched.items()}
    every = {rule: set[tuple[str, ...]]().union(*map(distinct, searches)) for rule, searches in searched.items()}
    return FailureSearchResult(
        scenarios=len(next(iter(searched.values()))[0]),
        found=found,
        distinct={rule: mean_over_seeds([float(one.distinct) for one in counts]) for rule, counts in found.items()},
        ratios={f"{one} / {other}": mean_ratio(found[one], found[other]) for one, other in PAIRS},
        together={rule: len(cells) for rule, cells in every.items()},
        provenance=provenance(),
    )


def count(searched: Sequence[Searched]) -> Found:
    """Return the counts of one search."""
    frames = [frame for scenario in searched for frame in scenario.tested]
    return Found(
        frames=len(frames),
        failing=sum(bool(frame.failures) for frame in frames),
        failures=sum(len(frame.failures) for frame in frames),
        growth=tuple(len(distinct(searched[: number + 1])) for number in range(len(searched))),
    )


def mean_ratio(one: Sequence[Found], other: Sequence[Found]) -> Estimate:
    """Return the geometric mean over seeds of the ratio of distinct failures; 0 failures count as one half."""
    ratios = [max(a.distinct, 0.5) / max(b.distinct, 0.5) for a, b in zip(one, other, strict=True)]
    logs = mean_over_seeds(np.log(ratios).tolist())
    low, high = (None if end is None else float(np.exp(end)) for end in (logs.low, logs.high))
    return Estimate(float(np.exp(logs.mean)), low, high)


def failure_search_tables(results: FailureSearchResult) -> dict[str, str]:
    """Return Markdown by name: found, ratios."""
    rows = []
    for rule, searches in results.found.items():
        frames, failing, failures = (
            float(np.mean([getattr(one, name) for one in searches])) for name in ("frames", "failing", "failures")
        )
        half = float(np.mean([one.growth[len(one.growth) // 2 - 1] for one in searches]))
        mean = results.distinct[rule].describe()
        row = [f"{frames:.0f}", f"{failing:.1f}", f"{failures:.1f}", f"{half:.1f}", mean, str(results.together[rule])]
        rows.append([NAMES[rule], *row])
    columns = ("rule", "frames", "with a failure", "failures", "distinct after half", "distinct", "all seeds together")
    ratios = [
        [f"{NAMES[one]} / {NAMES[other]}", results.ratios[name].describe()]
        for name in results.ratios
        for one, other in [name.split(" / ")]
    ]
    return {
        "found": format_table(columns, rows),
        "ratios": format_table(("distinct failures", "ratio, interval"), ratios),
    }


COLOURS = (style.MUTED, style.BLUE, style.ORANGE)


@style.styled
def draw_growth(lines: Mapping[str, NDArray[np.int64]], frames: float) -> Figure:
    """Return the chart of distinct failures (seeds, scenarios) by rule against tested frames, `frames` per scenario."""
    figure = style.canvas(6.0, 3.4)
    axes = figure.subplots()
    for (name, counts), colour in zip(lines.items(), COLOURS):
        at = frames * np.arange(1, counts.shape[1] + 1)
        axes.plot(at, counts.mean(axis=0), color=colour, label=name)
        axes.fill_between(at, counts.min(axis=0), counts.max(axis=0), color=colour, alpha=0.2, linewidth=0)
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
