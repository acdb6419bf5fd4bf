"""Closed-loop driving on the networks of the package, compared with ground truth.

Both arms drive the same scenarios and seeds with the same driver, which passes standing vehicles (`lines.passing`).
Driver and tracker were tuned on seeds below 100.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from flcav.driving.jobs import DriveJob, Sensed, run_jobs
from flcav.driving.loop import Loop
from flcav.driving.measures import DriveResult
from flcav.driving.scenarios import spread_scenarios
from flcav.driving.studies.importance import mean_measure, paired_difference
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.estimates import Estimate, score_interval
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

SCENARIOS, SEEDS, LASTS_S = 32, 3, 12.0
FIRST_SEED = 901  # drives with lower seeds were inspected
TOGETHER = 8  # number of drives of an arm before those of the next arm
ENOUGH = 0.8  # share of the progress by ground truth that networks should reach
TRUTH, NETWORKS = "ground truth", "networks"
ARMS: Mapping[str, Sensed] = {TRUTH: Sensed("truth"), NETWORKS: Sensed("networks")}
MEASURES = ("progress", "score", "faults", "red_lights", "hard_brakes")


@dataclass(frozen=True)
class ArmResult:
    """Measures of one arm over all drives, with intervals over scenarios; that of collisions is Wilson's."""

    progress: Estimate
    score: Estimate
    crashed: Estimate  # share of the drives with a collision at fault
    red_lights: int
    hard_brakes: Estimate  # per drive
    stood_s: Mapping[str, float]  # standstill in all drives [s] by cause, longest first


@dataclass(frozen=True)
class ClosedLoop(Record):
    """Results of the comparison in closed loop, over the same drives."""

    scenarios: int
    drives: int  # of each arm
    lasts_s: float
    arms: Mapping[str, ArmResult]
    differences: Mapping[str, Estimate]  # networks less ground truth, paired, by field of a drive
    beyond: Estimate  # progress of the networks less `ENOUGH` times that by ground truth, paired
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the measures in words."""
        return [
            f"{name}: progress {arm.progress.describe()}, {per_hundred(arm.crashed)} collisions at fault per hundred "
            f"drives, {plural(arm.red_lights, 'red light')} passed, stood {self.share_stood(arm):.0%} of the "
            "time"
            for name, arm in self.arms.items()
        ]

    def share_stood(self, arm: ArmResult) -> float:
        """Return the share of the time at standstill in an arm."""
        return sum(arm.stood_s.values()) / (self.drives * self.lasts_s)


def per_hundred(share: Estimate) -> str:
    """Return a share with its interval per hundred, in words."""
    return f"{100 * share.mean:.1f} ({100 * (share.low or 0.0):.1f} to {100 * (share.high or 0.0):.1f})"


def compare_perception(
    out: Path, seeds: int = SEEDS, jobs: int = 1, progress: Report = ignore_progress, scenarios: int = SCENARIOS
) -> ClosedLoop:
    """Drive scenarios of the package with `seeds` seeds, and return the comparison; drives are kept in `out`.

    Arms alternate, so that the results of an interrupted run are comparable.
    """
    pairs = [(scenario, FIRST_SEED + seed) for seed in range(seeds) for scenario in spread_scenarios(scenarios)]
    drives: dict[str, list[DriveResult]] = {name: [] for name in ARMS}
    for done in range(0, len(pairs), TOGETHER):
        for name, sensed in ARMS.items():
            batch = [DriveJob(*pair, loop=Loop(lasts_s=LASTS_S)) for pair in pairs[done : done + TOGETHER]]
            drives[name] += run_jobs(batch, sensed, jobs, kept=out / "drives.jsonl")
        progress(min(done + TOGETHER, len(pairs)), len(pairs), pairs[done][0].name)
    return summarise_arms(drives, scenarios)


def summarise_arms(drives: Mapping[str, Sequence[DriveResult]], scenarios: int) -> ClosedLoop:
    """Return the comparison of the arms' drives, through the same scenarios with the same seeds."""
    truth, networks = drives[TRUTH], drives[NETWORKS]
    names = [drive.scenario for drive in networks]
    enough = [replace(drive, progress=ENOUGH * drive.progress) for drive in truth]
    return ClosedLoop(
        scenarios=scenarios,
        drives=len(names),
        lasts_s=LASTS_S,
        arms={name: _summarise(of_arm) for name, of_arm in drives.items()},
        differences={measure: paired_difference(truth, networks, names, measure) for measure in MEASURES},
        beyond=paired_difference(enough, networks, names, "progress"),
        provenance=provenance(),
    )


def _summarise(drives: Sequence[DriveResult]) -> ArmResult:
    stood: dict[str, float] = {}
    for drive in drives:
        for cause, duration in drive.stood_s.items():
            stood[cause] = round(stood.get(cause, 0.0) + duration, 1)
    return ArmResult(
        progress=mean_measure(drives, "progress"),
        score=mean_measure(drives, "score"),
        crashed=score_interval(sum(drive.faults > 0 for drive in drives) / len(drives), len(drives)),
        red_lights=sum(drive.red_lights for drive in drives),
        hard_brakes=mean_measure(drives, "hard_brakes"),
        stood_s=dict(sorted(stood.items(), key=lambda item: -item[1])),
    )


def closed_loop_tables(results: ClosedLoop) -> dict[str, str]:
    """Return Markdown by name: arms, differences, standing."""
    rows = [
        [
            name,
            arm.progress.describe(),
            per_hundred(arm.crashed),
            str(arm.red_lights),
            arm.hard_brakes.describe(),
            f"{results.share_stood(arm):.1%}",
            arm.score.describe(),
        ]
        for name, arm in results.arms.items()
    ]
    columns = (
        "perception",
        "progress",
        "collisions at fault per hundred drives",
        "red lights passed",
        "hard brakes a drive",
        "time it stood",
        "score",
    )
    gaps = [[name.replace("_", " "), each.describe(sign=True)] for name, each in results.differences.items()]
    gaps.append([f"progress less {ENOUGH} of that by ground truth", results.beyond.describe(sign=True)])
    causes = list(dict.fromkeys(cause for arm in results.arms.values() for cause in arm.stood_s))
    stood = [[cause, *(f"{arm.stood_s.get(cause, 0.0):.1f}" for arm in results.arms.values())] for cause in causes]
    return {
        "arms": format_table(columns, rows),
        "differences": format_table(("networks less ground truth", "a drive"), gaps),
        "standing": format_table(("stood before [s]", *results.arms), stood),
    }


def _run(out: Path, options: Options) -> Outcome[ClosedLoop]:
    with options.show_progress(options.title) as report:
        results = compare_perception(out, options.seeds, options.jobs, report, 2 if options.quick else SCENARIOS)
    return Outcome(results, {}, results.sentences())


EXPERIMENT = Experiment(ClosedLoop, _run, closed_loop_tables, seeds=SEEDS, takes=("seeds", "scale", "jobs"))
