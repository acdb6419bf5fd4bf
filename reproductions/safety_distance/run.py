"""Safety distance: a margin by the calibrated uncertainty of perception, against a fixed one, in closed loop.

The article names it as future work. A driver keeps a margin free around the road users that it perceives and predicts.
The margin is fixed, or a multiple of the standard deviation of predicted positions, which grows with the time ahead and
differs between standing, driving and walking road users. Every setting drives the same scenarios and seeds with the
same errors of perception (`driving.errors`), so that settings are paired.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from flcav.driving.driver import DriverSettings
from flcav.driving.errors import ErrorModel, load_error_model
from flcav.driving.jobs import DriveJob, Sensed, run_jobs
from flcav.driving.loop import Loop
from flcav.driving.measures import DriveResult
from flcav.driving.scenarios import spread_scenarios
from flcav.driving.studies.importance import paired_difference
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.interface.progress import Report, ignore_progress
from flcav.report import style
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.estimates import Estimate
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

FIXED_M = (0.0, 0.4, 0.8, 1.2, 1.8)
SIGMAS = (0.25, 0.5, 1.0, 2.0)
SCENARIOS, SEEDS, LASTS_S = 16, 3, 12.0
FIRST_SEED = 311  # drives with lower seeds were inspected


@dataclass(frozen=True)
class MarginResult:
    """Measures of one setting of the margin, over all drives."""

    name: str
    uncertain: bool  # whether the margin is by uncertainty
    size: float  # fixed margin [m], or multiple of the standard deviation
    faults: int  # collisions at fault, in all drives
    near_share: float  # share of the time with less than 1.5 s to collision
    hard_brakes: float  # mean number per drive
    mean_speed: float  # [m/s]
    score: float


@dataclass(frozen=True)
class SafetyDistance(Record):
    """Measures of margins that are fixed or by uncertainty, and differences of the pair nearest in mean speed."""

    drives: int  # per setting
    settings: tuple[MarginResult, ...]
    compared: tuple[str, str]  # the fixed margin, and the one by uncertainty
    differences: Mapping[str, Estimate]  # the second less the first, by field of a drive
    errors: ErrorModel
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the measures of each setting and the differences as sentences."""
        lines = [
            f"{setting.name}: {setting.faults} collisions at fault in {self.drives} drives, {setting.hard_brakes:.2f} "
            f"hard brakes a drive, {setting.near_share:.1%} of the time below 1.5 s to collision, "
            f"{setting.mean_speed:.2f} m/s"
            for setting in self.settings
        ]
        gaps = ", ".join(f"{name} {gap.describe(sign=True)}" for name, gap in self.differences.items())
        return [*lines, f"{self.compared[1]} less {self.compared[0]}: {gaps}"]

    def picture(self) -> bytes:
        """Return the trade-off curve as a PNG."""
        lines = {
            name: [(e.mean_speed, e.near_share, e.hard_brakes, e.faults) for e in self.settings if e.uncertain == kind]
            for name, kind in (("fixed", False), ("by uncertainty", True))
        }
        return style.png(draw_trade_off(lines, self.drives))


def compare_margins(
    out: Path,
    seeds: int = SEEDS,
    jobs: int = 1,
    progress: Report = ignore_progress,
    scenarios: int = SCENARIOS,
) -> SafetyDistance:
    """Return the results over the package's scenarios and `seeds` seeds; drives are saved in the folder `out`."""
    model = load_error_model()
    settings = list_settings()
    drawn = range(FIRST_SEED, FIRST_SEED + seeds)
    pairs = [(scenario, seed) for scenario in spread_scenarios(scenarios) for seed in drawn]
    tasks = [DriveJob(*pair, loop=Loop(driver, LASTS_S)) for driver in settings.values() for pair in pairs]
    drives = run_jobs(tasks, Sensed("model", model), jobs, progress, out / "drives.jsonl")
    by_name = {name: drives[i * len(pairs) : (i + 1) * len(pairs)] for i, name in enumerate(settings)}
    return summarise_margins(by_name, model)


def list_settings() -> dict[str, DriverSettings]:
    """Return the compared margins by name: fixed ones, and multiples of the standard deviation."""
    fixed = {f"fixed {size:g} m": DriverSettings(size) for size in FIXED_M}
    return fixed | {f"{size:g} sigma": DriverSettings(0.0, size) for size in SIGMAS}


def summarise_margins(drives: Mapping[str, Sequence[DriveResult]], model: ErrorModel) -> SafetyDistance:
    """Return the results from the drives under each of `list_settings`, all of the same scenarios and seeds."""
    settings = list_settings()
    results = tuple(summarise(name, settings[name], of_setting) for name, of_setting in drives.items())
    compared = find_pair(results)
    first, second = (drives[name] for name in compared)
    names = [drive.scenario for drive in first]
    fields = ("near_share", "hard_brakes", "mean_speed", "faults", "score")
    return SafetyDistance(
        drives=len(first),
        settings=results,
        compared=compared,
        differences={name: paired_difference(first, second, names, name) for name in fields},
        errors=model,
        provenance=provenance(),
    )


def summarise(name: str, settings: DriverSettings, drives: Sequence[DriveResult]) -> MarginResult:
    """Return the measures of one setting."""

    def mean(field: str) -> float:
        return float(np.mean([getattr(drive, field) for drive in drives]))

    return MarginResult(
        name=name,
        uncertain=settings.sigmas > 0,
        size=settings.sigmas or settings.margin_m,
        faults=sum(drive.faults for drive in drives),
        near_share=mean("near_share"),
        hard_brakes=mean("hard_brakes"),
        mean_speed=mean("mean_speed"),
        score=mean("score"),
    )


def find_pair(results: Sequence[MarginResult]) -> tuple[str, str]:
    """Return the names of the fixed margin and the one by uncertainty that are nearest in mean speed."""
    pairs = [(a, b) for a in results for b in results if b.uncertain and not a.uncertain]
    first, second = min(pairs, key=lambda pair: abs(pair[0].mean_speed - pair[1].mean_speed))
    return first.name, second.name


def safety_tables(results: SafetyDistance) -> dict[str, str]:
    """Return Markdown by name: settings, differences."""
    rows = [
        [
            setting.name,
            str(setting.faults),
            f"{setting.hard_brakes:.2f}",
            f"{100 * setting.near_share:.1f} %",
            f"{setting.mean_speed:.2f}",
            f"{setting.score:.3f}",
        ]
        for setting in results.settings
    ]
    columns = ("margin", "collisions at fault", "hard brakes a drive", "time below 1.5 s", "mean speed [m/s]", "score")
    gaps = [[name, gap.describe(sign=True)] for name, gap in results.differences.items()]
    title = f"{results.compared[1]} less {results.compared[0]}"
    return {"settings": format_table(columns, rows), "differences": format_table((title, "mean, interval"), gaps)}


PANELS = ("time below 1.5 s to collision [%]", "hard brakes a drive", "collisions at fault")
COLOURS = (style.MUTED, style.BLUE)


def bound_count(count: int) -> tuple[float, float]:
    """Return the exact 95 % interval of the mean of a Poisson variable of which `count` was seen (Garwood, 1936)."""
    return float(chi2.ppf(0.025, 2 * count)) / 2 if count else 0.0, float(chi2.ppf(0.975, 2 * count + 2)) / 2


@style.styled
def draw_trade_off(lines: Mapping[str, Sequence[tuple[float, float, float, int]]], drives: int) -> Figure:
    """Return three panels against mean speed; `lines`: points (mean speed [m/s], near share, hard brakes, faults).

    Collisions are few: they have the interval of a count, and no line joins them. `drives`: per setting.
    """
    figure = style.canvas(9.6, 3.2)
    panels = figure.subplots(1, len(PANELS))
    for number, (axes, title) in enumerate(zip(panels, PANELS)):
        counted = number == len(PANELS) - 1
        for (name, points), colour in zip(lines.items(), COLOURS):
            values = np.array(points)
            height = values[:, number + 1] * (100 if number == 0 else 1)
            look = "o" if counted else "o-"
            axes.plot(values[:, 0], height, look, color=colour, markersize=4, label=name, clip_on=not counted, zorder=3)
            for speed, *_, faults in points if counted else ():
                style.interval(axes, speed, Estimate(faults, *bound_count(faults)), color=colour, linewidth=1)
        axes.set(xlabel="mean speed [m/s]", title=f"{title}, in {drives} drives" if counted else title)
        axes.set_ylim(bottom=0)
        axes.grid(axis="y")
    style.key(figure, panels[0].get_lines())
    return figure


def _run(out: Path, options: Options) -> Outcome[SafetyDistance]:
    with options.show_progress(options.title) as report:
        results = compare_margins(out, options.seeds, options.jobs, report, 2 if options.quick else SCENARIOS)
    return Outcome(results, {"trade_off.png": results.picture()}, results.sentences())


EXPERIMENT = Experiment(SafetyDistance, _run, safety_tables, takes=("seeds", "scale", "jobs"))
