"""Benefit of roadside sensors on poles for driving: occlusion, detection precision and closed-loop safety.

The article motivates road sensors by a vehicle's occlusions (Wang et al., IEEE Network 37(3), 2023). Cars and vans in
the field of the vehicle's detector are counted; one that no ray reaches is hidden (`seen.share_seen`). In closed loop,
the same drives are run with and without the detections of the poles.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flcav.driving.loop import LOOP, Loop, drive_scenario
from flcav.driving.measures import DriveResult
from flcav.driving.networks import NetworkPerception
from flcav.driving.road import SPIN_S, RoadUnits
from flcav.driving.scenarios import DrivingScenario, StagedScenario
from flcav.driving.seen import EGO, EYE_M, FIELD_M, Seen, share_seen
from flcav.driving.studies.importance import paired_difference
from flcav.geometry import Array, Boxes, rotate
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.metrics.detection import match, weighted_precision
from flcav.perception.objects.truth import CARS
from flcav.statistics.bootstrap import bootstrap_over_scenes
from flcav.statistics.estimates import Estimate, score_interval
from flcav.statistics.streams import stream
from flcav.storage.records import Record
from flcav.world.line_of_sight import look_at_instants
from flcav.world.map.town import Town
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot
from flcav.world.trace import Trace

INSTANTS = 40  # of recorded traffic


@dataclass(frozen=True)
class Hidden(Record):
    """Shares of the cars around vehicles that are hidden, with Wilson's intervals; None without cars."""

    cars: int
    vehicle: Estimate | None  # from the vehicle
    poles: Estimate | None  # from all poles: occluded or out of range
    both: Estimate | None  # from the vehicle and all poles

    def lines(self) -> list[str]:
        """Return the shares in words."""
        if self.vehicle is None or self.poles is None or self.both is None:
            return ["nobody drives near the vehicles"]
        return [
            f"of {self.cars} cars around vehicles hidden from the vehicle {self.vehicle.describe()}, "
            f"from every pole {self.poles.describe()}, from both {self.both.describe()}"
        ]


def find_hidden(scene: Scene, own: int, sites: Sequence[Array], range_m: float) -> tuple[Boxes, NDArray[np.bool_]]:
    """Return the cars in the detector field of the vehicle in row `own`, and flags (N, 2) whether they are hidden.

    The flags are for the vehicle and for all sites. Boxes are in the world frame, `sites` are positions (3,) [m] with a
    range of `range_m` [m].
    """
    trace, i = scene.trace, scene.index
    rows = np.flatnonzero(trace.present[i] & np.isin(trace.category, CARS))
    rows = rows[rows != own]
    at, yaw = trace.position[i, own], float(trace.yaw[i, own])
    x, y = rotate(trace.position[i, rows, 0] - at[0], trace.position[i, rows, 1] - at[1], -yaw)
    rows = rows[(x > 0) & (x < FIELD_M[0]) & (np.abs(y) < FIELD_M[1])]
    size = trace.size[rows]
    boxes = Boxes(trace.position[i, rows] + size * (0.0, 0.0, 0.5), size, trace.yaw[i, rows], np.full(len(rows), "Car"))
    hidden = np.ones((len(rows), 2), np.bool_)
    hidden[:, 0] = share_seen(scene, at + np.array((0.0, 0.0, EYE_M)), boxes, own) == 0
    for site in sites:
        near = np.linalg.norm(boxes.center - site, axis=1) <= range_m
        hidden[near, 1] &= share_seen(scene, site, boxes[near]) == 0
    return boxes, hidden


def summarise_hidden(flags: Sequence[NDArray[np.bool_]]) -> Hidden:
    """Return the shares of hidden cars by the flags (N, 2) of all instants."""
    joined = np.concatenate([np.zeros((0, 2), np.bool_), *flags])
    n = len(joined)
    if not n:
        return Hidden(0, None, None, None)
    vehicle, poles, both = joined[:, 0].mean(), joined[:, 1].mean(), joined.all(axis=1).mean()
    return Hidden(n, *(score_interval(float(share), n) for share in (vehicle, poles, both)))


def count_hidden(town: Town, traces: Sequence[Trace], sites: Array, ranges_m: Sequence[float]) -> Hidden:
    """Return the shares of cars hidden from connected vehicles ("cav0", ...) and from sites (P, 3) in recorded traffic.

    About `INSTANTS` instants are evaluated. Without connected vehicles every moving car counts as one. `sites` are
    positions in the world frame [m], `ranges_m` their ranges [m].
    """
    flags = []
    for scene in look_at_instants(town, traces, INSTANTS):
        trace, i = scene.trace, scene.index
        names = np.char.startswith(trace.actor, "cav") & trace.present[i]
        if not names.any():
            driving = np.linalg.norm(trace.velocity[i, :, :2], axis=1) > 1.0
            names = trace.present[i] & np.isin(trace.category, CARS) & driving
        for vehicle in np.flatnonzero(names).tolist():
            flags.append(_hidden_of(scene, vehicle, sites, ranges_m))
    return summarise_hidden(flags)


def _hidden_of(scene: Scene, vehicle: int, sites: Array, ranges_m: Sequence[float]) -> NDArray[np.bool_]:
    """Return the flags (N, 2) of the cars around one vehicle, for sites with individual ranges."""
    _, hidden = find_hidden(scene, vehicle, [], 0.0)
    for site, range_m in zip(sites, ranges_m, strict=True):
        hidden[:, 1] &= find_hidden(scene, vehicle, [site], range_m)[1][:, 1]
    return hidden


RANGE_M = 40.0  # of a pole's sensor
GAINS = {
    "least_ttc_s": "least time to collision [s]",
    "near_share": "share of time below 1.5 s to collision",
    "faults": "collisions at fault",
    "hard_brakes": "hard brakes",
    "score": "driving score",
}
OVERLAP = 0.3  # bird's-eye IoU of a detected car: enough for braking, with messages that are half a second old


@dataclass
class FusionTally:
    """Detections by the vehicle alone and with poles, the true cars, and the latencies, step by step."""

    scenario: list[str] = field(default_factory=list)
    own: list[Boxes] = field(default_factory=list)
    fused: list[Boxes] = field(default_factory=list)
    targets: list[Boxes] = field(default_factory=list)
    hidden: list[NDArray[np.bool_]] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)


class Cooperative:
    """Cooperative perception by vehicle and roadside units, which tallies its detections and the true cars."""

    def __init__(self, staged: StagedScenario, seed: int, poles: Sequence[int], tally: FusionTally) -> None:
        self._units = RoadUnits(staged.town, poles, seed)
        self._networks = NetworkPerception(staged, seed, road=self._units)
        self._scenario, self._tally, self._looked_s = staged.scenario.name, tally, -SPIN_S

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the cooperative perception at this instant."""
        seen = self._networks.look(snapshot)
        if snapshot.time_s - self._looked_s >= SPIN_S - 1e-6:
            self._looked_s = snapshot.time_s
            ego = snapshot.row(EGO)
            sites = list(self._units.sites.values())
            targets, hidden = find_hidden(self._networks.scene, ego, sites, RANGE_M)
            place = (*snapshot.trace.position[0, ego, :2].tolist(), float(snapshot.trace.yaw[0, ego]))
            self._tally.scenario.append(self._scenario)
            self._tally.own.append(keep_in_field(self._networks.own, place))
            self._tally.fused.append(keep_in_field(self._networks.found, place))
            self._tally.targets.append(targets)
            self._tally.hidden.append(hidden)
            self._tally.latency_s += self._units.latency_s
            self._units.latency_s.clear()
        return seen


def keep_in_field(boxes: Boxes, place: tuple[float, float, float]) -> Boxes:
    """Return the cars (world frame) in the detector field of a vehicle at `place`: x, y [m], yaw [rad]."""
    x, y = rotate(boxes.center[:, 0] - place[0], boxes.center[:, 1] - place[1], -place[2])
    return boxes[(boxes.label == "Car") & (x > 0) & (x < FIELD_M[0]) & (np.abs(y) < FIELD_M[1])]


@dataclass(frozen=True)
class Precision(Record):
    """AP of the cars in the vehicle's field, hidden ones included, with bootstrap intervals over scenarios."""

    vehicle: Estimate  # alone
    fused: Estimate  # with the messages of poles
    gain: Estimate  # paired difference

    def line(self) -> str:
        """Return the precision in words."""
        both = f"{self.vehicle.describe()}, with the poles {self.fused.describe()}"
        return f"AP of the vehicle alone {both}, with less without {self.gain.describe(sign=True)}"


def measure_precision(tally: FusionTally) -> Precision | None:
    """Return the AP of the vehicle alone and with poles for a tally; None without cars."""
    if not sum(map(len, tally.targets)):
        return None
    none = [Boxes.empty()] * len(tally.targets)
    own, fused = (match(detections, tally.targets, none, OVERLAP, "bev") for detections in (tally.own, tally.fused))

    def estimate(measure: Callable[[NDArray[np.int64]], Array]) -> Estimate:
        value = float(measure(np.ones((1, len(none)), np.int64))[0])
        if len(set(tally.scenario)) < 2:
            return Estimate(value, None, None)
        return Estimate(value, *bootstrap_over_scenes(measure, tally.scenario, rng=stream(0, "poles")))

    return Precision(
        estimate(lambda times: weighted_precision(own, times)),
        estimate(lambda times: weighted_precision(fused, times)),
        estimate(lambda times: weighted_precision(fused, times) - weighted_precision(own, times)),
    )


@dataclass(frozen=True)
class ClosedLoopGain(Record):
    """Benefit of roadside sensors in closed loop, by the same drives with and without them."""

    poles: tuple[int, ...]  # numbers in the town
    hidden: Hidden
    precision: Precision | None  # None where there are no cars
    latency_s: float | None  # mean age of a message on arrival; None where none arrived
    without: tuple[DriveResult, ...]
    with_poles: tuple[DriveResult, ...]

    def lines(self) -> list[str]:
        """Return the gain in words."""
        lines = self.hidden.lines()
        if self.precision is not None:
            lines.append(self.precision.line())
        late = "no message arrived" if self.latency_s is None else f"messages are {self.latency_s:.3f} s old on arrival"
        for name, drives in (("without poles", self.without), ("with poles", self.with_poles)):
            ttc = float(np.mean([drive.least_ttc_s for drive in drives]))
            near = float(np.mean([drive.near_share for drive in drives]))
            faults = sum(drive.faults for drive in drives)
            score = float(np.mean([drive.score for drive in drives]))
            reds = plural(sum(drive.red_lights for drive in drives), "red light")
            lines.append(
                f"{name}: least time to collision {ttc:.2f} s, below 1.5 s for {near:.1%} of the time, "
                f"{plural(faults, 'collision')} at fault, {reds} passed, driving score {score:.2f}"
            )
        names = [drive.scenario for drive in self.without]
        if len(set(names)) > 1:
            gaps = {measure: paired_difference(self.without, self.with_poles, names, measure) for measure in GAINS}
            changes = ", ".join(f"{words} {gaps[measure].describe(sign=True)}" for measure, words in GAINS.items())
            lines.append(f"with less without, paired: {changes}")
        return [*lines, late]


def measure_pole_gain(
    scenarios: Sequence[DrivingScenario],
    seeds: Sequence[int],
    poles: Sequence[int],
    loop: Loop = LOOP,
    progress: Report = ignore_progress,
) -> ClosedLoopGain:
    """Return the benefit of roadside units on poles of the scenarios' town; raises `InputError` for an unknown pole."""
    tally = FusionTally()
    without, with_poles = list[DriveResult](), list[DriveResult]()
    pairs = [(scenario, seed) for scenario in scenarios for seed in seeds]
    for done, (scenario, seed) in enumerate(pairs, start=1):
        without.append(drive_scenario(scenario, seed, NetworkPerception, loop))
        with_poles.append(
            drive_scenario(scenario, seed, lambda staged, number: Cooperative(staged, number, poles, tally), loop)
        )
        progress(done, len(pairs), scenario.name)
    late = float(np.mean(tally.latency_s)) if tally.latency_s else None
    hidden, precision = summarise_hidden(tally.hidden), measure_precision(tally)
    return ClosedLoopGain(tuple(poles), hidden, precision, late, tuple(without), tuple(with_poles))
