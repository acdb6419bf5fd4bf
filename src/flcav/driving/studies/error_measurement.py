"""Measurement of the networks' errors on drives: recall, position errors, and forecast errors over four seconds.

Ground truth drives the vehicle, and the networks' output is compared with it; the result is an `errors.ErrorModel`.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from flcav.driving.errors import CLASSES, EDGES_M, ErrorModel, find_in_field
from flcav.driving.following import MOTIONS
from flcav.driving.jobs import begin_worker
from flcav.driving.loop import Loop, drive_scenario
from flcav.driving.networks import NetworkPerception
from flcav.driving.obstacles import OBSTACLE
from flcav.driving.scenarios import DrivingScenario, StagedScenario
from flcav.driving.seen import EGO, TIMES_S, Seen, TruePerception, find_around
from flcav.geometry import Array, concatenate, rotate, wrap_angle
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.processes import process_pool
from flcav.world.snapshot import Snapshot

MATCH_M = 2.5  # greatest distance between a detection and its road user
ONE_SIGMA = 0.6827  # a quantile in place of the standard deviation, since outliers do not widen it
HORIZON = slice(0, len(TIMES_S), 2)  # (H,) of `TIMES_S` at which forecasts are compared


def _by_class() -> defaultdict[str, Counter[str]]:
    return defaultdict(Counter)


@dataclass
class Tally:
    """Counts and errors over drives."""

    # class, distance [m], whether detected, errors of x, y [m] in the ego frame and of yaw [rad]
    pairs: list[tuple[str, float, bool, float, float, float]] = field(default_factory=list)
    false_positives: int = 0
    frames: int = 0
    lights: Counter[str] = field(default_factory=Counter)
    weather: defaultdict[str, Counter[str]] = field(default_factory=_by_class)
    tracks: list[tuple[str, float, Array]] = field(default_factory=list)  # motion, variance [m^2], errors (H, 2) [m]

    def add(self, other: "Tally") -> None:
        """Add the counts of another drive."""
        self.pairs += other.pairs
        self.tracks += other.tracks
        self.false_positives += other.false_positives
        self.frames += other.frames
        self.lights += other.lights
        for name, counts in other.weather.items():
            self.weather[name] += counts


class Comparing:
    """Ground-truth perception that also counts the networks' errors at every step."""

    def __init__(self, staged: StagedScenario, seed: int, tally: Tally) -> None:
        self._networks, self._truth = NetworkPerception(staged, seed), TruePerception(staged.scenario.weather)
        self._tally, self._class = tally, staged.scenario.weather
        self._forecasts: list[tuple[float, str, str, float, Array]] = []
        self._places: dict[tuple[str, int], Array] = {}

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the truth, and count the networks' errors against it."""
        self._networks.look(snapshot)
        self._compare(snapshot)
        self._remember(snapshot)
        if self._networks.lights_read_s == snapshot.time_s:
            self._tally.weather[self._class][self._networks.named] += 1
            letters = dict(zip(snapshot.trace.light.tolist(), snapshot.trace.light_state[0].tolist()))
            for link, letter in self._networks.heads.items():
                right = letter is not None and (letter == "G") == (letters.get(link) in ("G", "g"))
                self._tally.lights["unread" if letter is None else "right" if right else "wrong"] += 1
        return self._truth.look(snapshot)

    def _compare(self, snapshot: Snapshot) -> None:
        _, boxes, local = find_in_field(snapshot, self._networks.scene)
        found = concatenate([self._networks.found, self._networks.obstacles])
        yaw = float(snapshot.trace.yaw[0, snapshot.row(EGO)])
        free = np.ones(len(found), np.bool_)
        for row in np.argsort(np.hypot(*local.T)).tolist():
            label, distance = str(boxes.label[row]), float(np.hypot(*local[row]))
            apart = found.center[:, :2] - boxes.center[row, :2]
            if label == OBSTACLE:  # whose box is of the side that is seen
                apart = _outside(apart, boxes.size[row, :2], float(boxes.yaw[row]))
            away = np.hypot(*apart.T)
            same = free & (found.label == label) & (away < MATCH_M)
            if not same.any():
                self._tally.pairs.append((label, distance, False, 0.0, 0.0, 0.0))
                continue
            best = int(np.argmin(np.where(same, away, np.inf)))
            free[best] = False
            x, y = rotate(float(apart[best, 0]), float(apart[best, 1]), -yaw)
            # Errors of heading are modulo pi: tracking corrects boxes that are detected the wrong way round. Those of
            # obstacles are modulo pi / 2: the side that is seen may be the short one.
            sides = 4 if label == OBSTACLE else 2
            turn = float(wrap_angle(sides * (found.yaw[best] - boxes.yaw[row]))) / sides
            self._tally.pairs.append((label, distance, True, float(x), float(y), turn))
        rows = find_around(snapshot, 80.0)
        everyone = snapshot.trace.position[0, rows, :2]
        lonely = [np.hypot(*(everyone - center[:2]).T).min(initial=np.inf) > 3.0 for center in found.center[free]]
        self._tally.false_positives += int(sum(lonely))
        self._tally.frames += 1

    def _remember(self, snapshot: Snapshot) -> None:
        """Keep the present forecasts, and record the errors of those whose horizon has passed."""
        trace, tick = snapshot.trace, round(snapshot.time_s * 10)
        for name, place in zip(trace.actor.tolist(), trace.position[0, :, :2]):
            self._places[name, tick] = place
        followed = self._networks.followed
        if followed is not None and tick % 5 == 0:
            rows = find_around(snapshot, 80.0)
            for i in range(len(followed.boxes)):
                away = np.hypot(*(trace.position[0, rows, :2] - followed.boxes.center[i, :2]).T)
                if len(away) and away.min() < MATCH_M and followed.boxes.variance is not None:
                    variance = float(followed.boxes.variance[i, :2].mean())
                    motion = followed.motion[i]
                    name = str(trace.actor[rows[int(away.argmin())]])
                    self._forecasts.append((snapshot.time_s, name, motion, variance, followed.path[i, HORIZON]))
        last = TIMES_S[HORIZON][-1]
        over = [forecast for forecast in self._forecasts if forecast[0] + last <= snapshot.time_s + 1e-6]
        self._forecasts = self._forecasts[len(over) :]
        for time_s, name, motion, variance, path in over:
            ticks = [round(10 * (time_s + float(t))) for t in TIMES_S[HORIZON]]
            places = [self._places.get((name, tick)) for tick in ticks]
            if all(place is not None for place in places):
                self._tally.tracks.append((motion, variance, path - np.array(places)))


def _outside(apart: Array, size: Array, yaw: float) -> Array:
    """Return the displacements (N, 2) [m] from the outline of a box to points; 0 within it.

    apart: (N, 2) from the box's centre [m]; size: its length and width [m].
    """
    along, across = rotate(apart[:, 0], apart[:, 1], -yaw)
    local = np.stack((along, across), axis=1)
    local -= np.clip(local, -size / 2, size / 2)
    return np.stack(rotate(local[:, 0], local[:, 1], yaw), axis=1)


def measure_errors(
    scenarios: Sequence[DrivingScenario],
    seeds: Sequence[int],
    loop: Loop,
    processes: int = 1,
    progress: Report = ignore_progress,
) -> ErrorModel:
    """Return the error model of the package's networks over drives of these scenarios and seeds."""
    jobs = [(scenario, seed, loop) for scenario in scenarios for seed in seeds]
    whole = Tally()
    with process_pool(processes, begin_worker) as pool:
        for done, tally in enumerate(pool.map(tally_drive, *zip(*jobs)), start=1):
            whole.add(tally)
            progress(done, len(jobs), "")
    return summarise_tally(whole)


def tally_drive(scenario: DrivingScenario, seed: int, loop: Loop) -> Tally:
    """Return the counts of the networks' errors in one drive."""
    tally = Tally()
    drive_scenario(scenario, seed, lambda staged, number: Comparing(staged, number, tally), loop)
    return tally


def summarise_tally(tally: Tally) -> ErrorModel:
    """Return the error model of a tally; recalls are posterior means under the Jeffreys prior (half a count each)."""
    detected: dict[str, tuple[float, ...]] = {}
    sd: dict[str, tuple[float, float, float]] = {}
    for name in CLASSES:
        rows = np.array([pair[1:] for pair in tally.pairs if pair[0] == name], np.float64).reshape(-1, 5)
        bins = np.digitize(rows[:, 0], EDGES_M[1:-1])
        detected[name] = tuple(
            float((rows[bins == b, 1].sum() + 0.5) / ((bins == b).sum() + 1)) for b in range(len(EDGES_M) - 1)
        )
        hit = rows[rows[:, 1] > 0, 2:]
        x, y, yaw = np.sqrt((hit**2).mean(axis=0)).tolist() if len(hit) else (0.3, 0.3, 0.2)
        sd[name] = (x, y, yaw)
    total = max(tally.lights.total(), 1)
    counted = tally.weather.items()
    off = [errors[0] / np.sqrt(variance) for _, variance, errors in tally.tracks]
    factor = float(np.quantile(np.abs(off), ONE_SIGMA)) ** 2 if off else 1.0
    return ErrorModel(
        detected=detected,
        sd=sd,
        false_positives=float(tally.false_positives) / max(tally.frames, 1),
        lights=(tally.lights["right"] / total, tally.lights["wrong"] / total),
        weather={name: {read: n / counts.total() for read, n in counts.items()} for name, counts in counted},
        spread_factor=factor,
        growth={motion: _growth(tally, motion, factor) for motion in MOTIONS},
        seen=len(tally.pairs),
        frames=tally.frames,
    )


def _growth(tally: Tally, motion: str, factor: float) -> tuple[float, ...]:
    """Return the standard deviation [m] of forecasts at `TIMES_S` in excess of that of their tracks."""
    tracks = [track for track in tally.tracks if track[0] == motion]
    if not tracks:
        return (0.0,) * len(TIMES_S)
    off = np.abs(np.array([errors for _, _, errors in tracks])).transpose(1, 0, 2).reshape(len(TIMES_S[HORIZON]), -1)
    variance = factor * float(np.median([variance for _, variance, _ in tracks]))
    excess = np.sqrt(np.maximum(np.quantile(off, ONE_SIGMA, axis=1) ** 2 - variance, 0.0))
    return tuple(np.interp(TIMES_S, TIMES_S[HORIZON], excess).tolist())
