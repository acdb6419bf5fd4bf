"""Lateral error of driving by the lanes that the road network sees, against driving by the map.

The same drives by the networks are steered along the map's route, and along the lane that the camera sees where it sees
one. The lateral error is the distance of the vehicle's centre from the centre of its lane by the map, while it moves
and goes around nobody. The centres that were seen are themselves compared with the map's, by their distance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product

import numpy as np

from flcav.arrays import Array, Ints
from flcav.config import InputError
from flcav.driving.driver import Decision, EgoMotion
from flcav.driving.jobs import begin_worker
from flcav.driving.lines.lane_keeping import STATIONS_M
from flcav.driving.loop import LOOP, Loop, drive_staged
from flcav.driving.measures import DriveResult
from flcav.driving.networks import NetworkPerception
from flcav.driving.scenarios import DrivingScenario, StagedScenario
from flcav.driving.seen import Seen
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.machine.processes import process_pool
from flcav.statistics.bootstrap import bootstrap_over_scenes
from flcav.statistics.estimates import Estimate
from flcav.statistics.streams import stream
from flcav.storage.records import Record
from flcav.world.snapshot import Snapshot

MOVES_MPS = 1.0  # speed from which on lateral errors count
RANGES_M = (5.0, 10.0, 15.0, 20.0, 31.0)  # borders of the ranges of centres that were seen
HIGH = 0.95  # quantile of the errors that is reported


@dataclass
class LaneTally:
    """The lateral errors of one drive by step, and the centres that were seen by picture."""

    aside_m: list[float] = field(default_factory=list)  # of the vehicle, to the left of its route
    steered: list[str] = field(default_factory=list)  # along what, as of `Decision`
    centres: list[Array] = field(default_factory=list)  # (S,) as of `find_centres`; the truth is 0


def drive_lanes(scenario: DrivingScenario, seed: int, loop: Loop, lanes: bool) -> tuple[DriveResult, LaneTally]:
    """Return a drive by the networks with its lateral errors; with `lanes` it steers along those that it sees."""
    tally, staged = LaneTally(), StagedScenario(scenario, seed)
    try:
        perception = NetworkPerception(staged, seed, lanes=lanes)

        def watch(snapshot: Snapshot, seen: Seen, own: EgoMotion, decision: Decision) -> None:
            if own.speed < MOVES_MPS or decision.steered == "beside":
                return
            tally.aside_m.append(staged.route.project(own.x, own.y, own.along)[1])
            tally.steered.append(decision.steered)
            if perception.lanes is not None and perception.pictured:
                tally.centres.append(perception.lanes.centres)

        return drive_staged(staged, seed, perception, loop, watch), tally
    finally:
        staged.world.close()


@dataclass(frozen=True)
class LateralError(Record):
    """The distance of a vehicle from the centre of its lane over some drives, with intervals over drives."""

    mean_m: Estimate  # without sign
    high_m: float  # 95 % quantile
    steps: int  # of 0.1 s
    seen: float  # share of them at which it steered along a lane that it saw


@dataclass(frozen=True)
class CentreError(Record):
    """The errors of the lane's centre as it is seen at a distance; None where none was seen."""

    from_m: float
    to_m: float
    seen: float  # share of the places at which a centre was seen
    mean_m: float | None  # without sign
    bias_m: float | None  # to the left
    high_m: float | None  # 95 % quantile, without sign


@dataclass(frozen=True)
class LaneGain(Record):
    """Lateral errors of the same drives by the map and by the lanes that are seen, and of the lanes themselves."""

    by_map: LateralError
    by_lanes: LateralError
    more_m: Estimate  # mean error by the lanes less that by the map
    centres: tuple[CentreError, ...]
    map_drives: tuple[DriveResult, ...]
    lane_drives: tuple[DriveResult, ...]

    def lines(self) -> list[str]:
        """Return the errors in words."""
        rows = []
        for name, error, drives in (
            ("by the map", self.by_map, self.map_drives),
            ("by the lanes", self.by_lanes, self.lane_drives),
        ):
            faults = plural(sum(drive.faults for drive in drives), "collision")
            rows.append(
                f"{name}: {error.mean_m.describe()} m aside, 95 % within {error.high_m:.3f} m, in {error.steps} steps "
                f"of {plural(len(drives), 'drive')}, {error.seen:.0%} of them along a lane that is seen; {faults} "
                "at fault"
            )
        rows.append(f"more by the lanes, paired: {self.more_m.describe(sign=True)} m")
        for row in self.centres:
            off = "" if row.mean_m is None else f", {row.mean_m:.3f} m off, {row.bias_m:+.3f} m to the left"
            high = "" if row.high_m is None else f", 95 % within {row.high_m:.3f} m"
            rows.append(f"lane at {row.from_m:g} to {row.to_m:g} m: seen {row.seen:.0%}{off}{high}")
        return rows


def measure_lane_gain(
    scenarios: Sequence[DrivingScenario],
    seeds: Sequence[int],
    loop: Loop = LOOP,
    processes: int = 1,
    progress: Report = ignore_progress,
) -> LaneGain:
    """Return the lateral errors of drives of these scenarios and seeds, by the map and by the lanes that are seen.

    Raises `InputError` where no vehicle moves, and what the drives raise.
    """
    jobs = [(*drive, loop, lanes) for drive, lanes in product(product(scenarios, seeds), (False, True))]
    driven = list[tuple[DriveResult, LaneTally]]()
    with process_pool(processes, begin_worker) as pool:
        for done, one in enumerate(pool.map(drive_lanes, *zip(*jobs)), start=1):
            driven.append(one)
            progress(done, len(jobs), one[0].scenario)
    by_map, by_lanes = ([tally for _, tally in driven[arm::2]] for arm in (0, 1))
    if not all(any(tally.aside_m for tally in tallies) for tallies in (by_map, by_lanes)):
        raise InputError(f"no vehicle reaches {MOVES_MPS:g} m/s in these drives; let them last longer")
    centres = np.concatenate([np.reshape(tally.centres, (-1, len(STATIONS_M))) for tally in by_lanes])
    return LaneGain(
        by_map=summarise_aside(by_map),
        by_lanes=summarise_aside(by_lanes),
        more_m=compare_aside(by_map, by_lanes),
        centres=tuple(summarise_centres(centres, low, high) for low, high in pairwise(RANGES_M)),
        map_drives=tuple(drive for drive, _ in driven[0::2]),
        lane_drives=tuple(drive for drive, _ in driven[1::2]),
    )


def summarise_aside(tallies: Sequence[LaneTally]) -> LateralError:
    """Return the lateral error over the steps of drives, of which there is one at least."""
    off = np.abs(np.concatenate([tally.aside_m for tally in tallies]))
    steered = [by for tally in tallies for by in tally.steered]
    sums, steps = _sums(tallies)
    mean = _estimate(lambda times: (times @ sums) / (times @ steps), len(tallies))
    return LateralError(mean, float(np.quantile(off, HIGH)), len(off), steered.count("lane") / len(steered))


def compare_aside(first: Sequence[LaneTally], second: Sequence[LaneTally]) -> Estimate:
    """Return the mean lateral error [m] of the second drives less that of the first, paired, with an interval."""
    (sums, steps), (other, number) = _sums(first), _sums(second)
    return _estimate(lambda times: (times @ other) / (times @ number) - (times @ sums) / (times @ steps), len(first))


def summarise_centres(centres: Array, low: float, high: float) -> CentreError:
    """Return the errors of centres (N, S) at the stations from `low` to `high` [m]."""
    part = centres[:, (low <= STATIONS_M) & (high > STATIONS_M)]
    off = part[np.isfinite(part)]
    if not len(off):
        return CentreError(low, high, 0.0, None, None, None)
    size = np.abs(off)
    return CentreError(
        low, high, len(off) / part.size, float(size.mean()), float(off.mean()), float(np.quantile(size, HIGH))
    )


def _sums(tallies: Sequence[LaneTally]) -> tuple[Array, Ints]:
    """Return the sum of the lateral errors [m] of each drive, without sign, and the number of its steps."""
    return np.array([np.abs(t.aside_m).sum() for t in tallies]), np.array([len(t.aside_m) for t in tallies])


def _estimate(measure: Callable[[Ints], Array], drives: int) -> Estimate:
    """Return a measure of multiplicities (n, drives) with an interval over drives; without one for a single drive."""
    value = float(measure(np.ones((1, drives), np.int64))[0])
    if drives < 2:
        return Estimate(value, None, None)
    with np.errstate(invalid="ignore"):  # of draws of drives in which nobody moves, which are left out
        return Estimate(value, *bootstrap_over_scenes(measure, np.arange(drives), rng=stream(0, "lanes")))
