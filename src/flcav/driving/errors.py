"""A model of the networks' errors, measured on drives: perception of the same quality at a small part of the time.

A perception error model (Piazzoni et al., "Modeling perception errors towards robust decision making in autonomous
vehicles", IJCAI 2020): road users in sight are detected with the measured probability for their class and distance,
with Gaussian errors of the measured size; lights and weather are read with the measured probabilities. Detections are
tracked, and forecast by the trajectory network, as those of the networks are. An actor stays detected or missed for
`HELD_S`. False positives are measured, and not modelled: a single one is never reported by the tracker.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import read_json
from flcav.driving.following import MOTIONS, Following, Spread, name_motion
from flcav.driving.loop import Loop, Sensing, drive
from flcav.driving.networks import LIGHTS_M, NetworkPerception, load_networks, load_roads
from flcav.driving.scenarios import Scenario, Staged
from flcav.driving.seen import EGO, TIMES_S, WEATHER_SPEED, Perception, Seen
from flcav.driving.truth import Truth, find_around, read_actors, read_lights
from flcav.driving.visibility import share_seen
from flcav.geometry import Boxes, heading_vectors, rotate, wrap_angle
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.processes import process_pool
from flcav.perception.objects.truth import DETECTION_CLASS
from flcav.statistics.streams import stream
from flcav.storage.records import Record
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot

Array = NDArray[np.float64]

EDGES_M = (0.0, 15.0, 30.0, 52.0)  # distances between which errors are measured
CLASSES = ("Car", "Pedestrian", "Cyclist")
FIELD_M = (51.2, 28.8)  # ahead, and to each side: the field of the network `small`
EYE_M = 1.85
SHIPPED = Path(__file__).parent / "shipped" / "errors.json"
MATCH_M = 2.5
HELD_S = 1.0
ONE_SIGMA = 0.6827  # share of a normal distribution within one standard deviation: outliers do not widen that
LIGHTS_S = 0.5  # between two looks at lights
HORIZON = slice(0, len(TIMES_S), 2)


@dataclass(frozen=True)
class ErrorModel(Record):
    """Error model of the perception networks, as measured."""

    detected: Mapping[str, tuple[float, ...]]  # by class: share of those in sight, between `EDGES_M`
    sd: Mapping[str, tuple[float, float, float]]  # by class: of x, y [m] along the ego vehicle's axes, and yaw [rad]
    false_positives: float  # a frame
    lights: tuple[float, float]  # share of the lights in the picture read right, and read wrong
    weather: Mapping[str, Mapping[str, float]]  # by true class: shares of the classes that are named
    spread_factor: float
    growth: Mapping[str, tuple[float, ...]]  # of `Spread`
    seen: int  # road users in sight, over all frames
    frames: int

    @property
    def spread(self) -> Spread:
        """Return the calibrated uncertainty of tracks."""
        return Spread(self.spread_factor, self.growth)


def find_in_field(snapshot: Snapshot, scene: Scene) -> tuple[NDArray[np.int64], Boxes, Array]:
    """Return rows and boxes (labels are detection classes) of the road users in field and sight; x, y (N, 2) [m].

    These are along and to the left of the ego vehicle, which looks ahead.
    """
    rows = find_around(snapshot, float(np.hypot(*FIELD_M)))
    rows = rows[np.isin(snapshot.trace.category[rows], list(DETECTION_CLASS))]
    boxes, _, _ = read_actors(snapshot, rows)
    own = snapshot.row(EGO)
    at, yaw = snapshot.trace.position[0, own], float(snapshot.trace.yaw[0, own])
    x, y = rotate(boxes.center[:, 0] - at[0], boxes.center[:, 1] - at[1], -yaw)
    within = (x > 0) & (x < FIELD_M[0]) & (np.abs(y) < FIELD_M[1])
    rows, boxes, local = rows[within], boxes[within], np.stack((x, y), axis=1)[within]
    seen = share_seen(scene, at + np.array((0.0, 0.0, EYE_M)), boxes, own) > 0
    labels = np.array([DETECTION_CLASS[each] for each in boxes.label[seen].tolist()], np.str_)
    kept = boxes[seen]
    return rows[seen], Boxes(kept.center, kept.size, kept.yaw, labels), local[seen]


def _by_class() -> defaultdict[str, Counter[str]]:
    return defaultdict(Counter)


@dataclass
class Tally:
    """Counts and errors over drives."""

    pairs: list[tuple[str, float, bool, float, float, float]] = field(
        default_factory=list
    )  # class, distance, found, errors
    false_positives: int = 0
    frames: int = 0
    lights: Counter[str] = field(default_factory=Counter)
    weather: defaultdict[str, Counter[str]] = field(default_factory=_by_class)
    tracks: list[tuple[str, float, Array]] = field(default_factory=list)  # motion, variance, errors (H, 2) at HORIZON

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
    """Perception by the networks, compared with the truth, by which the vehicle is driven."""

    def __init__(self, staged: Staged, seed: int, tally: Tally) -> None:
        self._networks, self._truth = NetworkPerception(staged, seed), Truth(staged.scenario.weather)
        self._tally, self._class = tally, staged.scenario.weather
        self._forecasts: list[tuple[float, str, str, float, Array]] = []
        self._places: dict[tuple[str, int], Array] = {}

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the truth; note what the networks make of it."""
        told = self._networks.look(snapshot)
        self._compare(snapshot)
        self._remember(snapshot)
        if self._networks.lights_read_s == snapshot.time_s:
            self._tally.weather[self._class][self._networks.named] += 1
            letters = dict(zip(snapshot.trace.light.tolist(), snapshot.trace.light_state[0].tolist()))
            for link, letter in self._networks.heads.items():
                right = letter is not None and (letter == "G") == (letters.get(link) in ("G", "g"))
                self._tally.lights["unread" if letter is None else "right" if right else "wrong"] += 1
        assert told is not None
        return self._truth.look(snapshot)

    def _compare(self, snapshot: Snapshot) -> None:
        _, boxes, local = find_in_field(snapshot, self._networks.scene)
        found, own = self._networks.found, snapshot.row(EGO)
        yaw = float(snapshot.trace.yaw[0, own])
        free = np.ones(len(found), np.bool_)
        for row in np.argsort(np.hypot(*local.T)).tolist():
            away = np.hypot(*(found.center[:, :2] - boxes.center[row, :2]).T)
            same = free & (found.label == boxes.label[row]) & (away < MATCH_M)
            label, distance = str(boxes.label[row]), float(np.hypot(*local[row]))
            if not same.any():
                self._tally.pairs.append((label, distance, False, 0.0, 0.0, 0.0))
                continue
            best = int(np.argmin(np.where(same, away, np.inf)))
            free[best] = False
            apart_x, apart_y = (found.center[best, :2] - boxes.center[row, :2]).tolist()
            x, y = rotate(apart_x, apart_y, -yaw)
            turn = float(wrap_angle(2 * (found.yaw[best] - boxes.yaw[row]))) / 2  # either way round
            self._tally.pairs.append((label, distance, True, float(x), float(y), turn))
        rows = find_around(snapshot, 80.0)
        everyone = snapshot.trace.position[0, rows, :2]
        lonely = [np.hypot(*(everyone - each[:2]).T).min(initial=np.inf) > 3.0 for each in found.center[free]]
        self._tally.false_positives += int(sum(lonely))
        self._tally.frames += 1

    def _remember(self, snapshot: Snapshot) -> None:
        """Note forecasts, and the errors of those whose horizon is over."""
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
                    motion = name_motion(str(followed.boxes.label[i]), followed.velocity[i])
                    name = str(trace.actor[rows[int(away.argmin())]])
                    self._forecasts.append((snapshot.time_s, name, motion, variance, followed.path[i, HORIZON]))
        last = TIMES_S[HORIZON][-1]
        over = [each for each in self._forecasts if each[0] + last <= snapshot.time_s + 1e-6]
        self._forecasts = self._forecasts[len(over) :]
        for time_s, name, motion, variance, path in over:
            ticks = [round(10 * (time_s + float(t))) for t in TIMES_S[HORIZON]]
            places = [self._places.get((name, each)) for each in ticks]
            if all(each is not None for each in places):
                self._tally.tracks.append((motion, variance, path - np.array(places)))


def measure_errors(
    scenarios: Sequence[Scenario],
    seeds: Sequence[int],
    loop: Loop,
    processes: int = 1,
    progress: Report = ignore_progress,
) -> ErrorModel:
    """Return the error model of the package's networks over drives of these scenarios and seeds."""
    jobs = [(scenario, seed, loop) for scenario in scenarios for seed in seeds]
    whole = Tally()
    with process_pool(processes, begin_worker) as pool:
        for done, own in enumerate(pool.map(tally_drive, *zip(*jobs)), start=1):
            whole.add(own)
            progress(done, len(jobs), "")
    return summarise(whole)


def load_errors(path: Path | None = None) -> ErrorModel:
    """Return the error model in a JSON file, by default that of the package; raises `InputError` for another file."""
    path = path or SHIPPED
    return ErrorModel.from_json(read_json(path), str(path))


def begin_worker() -> None:
    """Begin a worker process, which needs nothing."""


def tally_drive(scenario: Scenario, seed: int, loop: Loop) -> Tally:
    """Return what the networks get wrong in one drive."""
    tally = Tally()
    drive(scenario, seed, lambda staged, own: Comparing(staged, own, tally), loop)
    return tally


def summarise(tally: Tally) -> ErrorModel:
    """Return the model of what was counted; shares have half a success and half a failure added (Jeffreys)."""
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
    off = [each[2][0] / np.sqrt(each[1]) for each in tally.tracks]
    factor = float(np.quantile(np.abs(off), ONE_SIGMA)) ** 2 if off else 1.0
    return ErrorModel(
        detected=detected,
        sd=sd,
        false_positives=float(tally.false_positives) / max(tally.frames, 1),
        lights=(tally.lights["right"] / total, tally.lights["wrong"] / total),
        weather={name: {each: n / own.total() for each, n in own.items()} for name, own in counted},
        spread_factor=factor,
        growth={motion: _growth(tally, motion, factor) for motion in MOTIONS},
        seen=len(tally.pairs),
        frames=tally.frames,
    )


def _growth(tally: Tally, motion: str, factor: float) -> tuple[float, ...]:
    """Return the standard deviation at `TIMES_S` that forecasts have beyond that of their tracks."""
    own = [each for each in tally.tracks if each[0] == motion]
    if not own:
        return (0.0,) * len(TIMES_S)
    off = np.abs(np.array([each[2] for each in own])).transpose(1, 0, 2).reshape(len(TIMES_S[HORIZON]), -1)
    variance = factor * float(np.median([each[1] for each in own]))
    excess = np.sqrt(np.maximum(np.quantile(off, ONE_SIGMA, axis=1) ** 2 - variance, 0.0))
    return tuple(np.interp(TIMES_S, TIMES_S[HORIZON], excess).tolist())


class ModelledPerception:
    """Perception with the errors of a model."""

    def __init__(self, model: ErrorModel, staged: Staged, seed: int) -> None:
        self._model = model
        self._scene = Scene(staged.town, staged.world.snapshot.trace)
        self._random = stream(seed, "errors", staged.scenario.name)
        self._following = Following(load_networks().trajectory, load_roads(staged.town.name), model.spread)
        self._held: dict[str, tuple[float, float]] = {}
        self._read: dict[str, tuple[float, str]] = {}
        self._signals = staged.town.signals
        self._looked_s = -LIGHTS_S
        named = model.weather.get(staged.scenario.weather) or {staged.scenario.weather: 1.0}
        drawn = self._random.choice(list(named), p=list(named.values()))
        self._share = WEATHER_SPEED[str(drawn)]

    def look(self, snapshot: Snapshot) -> Seen:
        """Return what networks with these errors might find at this instant."""
        self._scene.follow(snapshot.trace)
        self._read_lights(snapshot)
        closed = frozenset(n for n, (_, letter) in self._read.items() if letter != "G")
        amber = frozenset(n for n, (_, letter) in self._read.items() if letter == "y")
        told = self._following.step(self._detect(snapshot), snapshot.time_s, closed)
        return Seen(told.boxes, told.velocity, told.path, told.yaw, told.spread, closed, amber, self._share)

    def _detect(self, snapshot: Snapshot) -> Boxes:
        rows, boxes, local = find_in_field(snapshot, self._scene)
        names = snapshot.trace.actor[rows].tolist()
        bins = np.digitize(np.hypot(*local.T), EDGES_M[1:-1])
        chance = np.array([self._model.detected[str(c)][b] for c, b in zip(boxes.label, bins)])
        found = np.array([self._hold(name, snapshot.time_s) for name in names]) < chance
        boxes = boxes[found] if len(rows) else boxes
        sd = np.array([self._model.sd[str(c)] for c in boxes.label]).reshape(-1, 3)
        noise = self._random.normal(size=(len(boxes), 3)) * sd
        yaw = float(snapshot.trace.yaw[0, snapshot.row(EGO)])
        off = np.stack(rotate(noise[:, 0], noise[:, 1], yaw), axis=1)
        variance = np.concatenate((sd[:, :2] ** 2, np.full((len(boxes), 4), 0.04), sd[:, 2:] ** 2), axis=1)
        centre = boxes.center + np.pad(off, ((0, 0), (0, 1)))
        return Boxes(centre, boxes.size, boxes.yaw + noise[:, 2], boxes.label, np.full(len(boxes), 0.8), variance)

    def _hold(self, name: str, time_s: float) -> float:
        """Return the number in [0, 1] by which an actor is found or not, drawn anew every `HELD_S`."""
        since, drawn = self._held.get(name, (-np.inf, 0.0))
        if time_s - since >= HELD_S:
            since, drawn = time_s, float(self._random.uniform())
            self._held[name] = (since, drawn)
        return drawn

    def _read_lights(self, snapshot: Snapshot) -> None:
        """Read the lights ahead anew every `LIGHTS_S`."""
        if snapshot.time_s - self._looked_s < LIGHTS_S - 1e-6:
            return
        self._looked_s = snapshot.time_s
        self._read = {n: each for n, each in self._read.items() if snapshot.time_s - each[0] <= 3.0}
        own = snapshot.row(EGO)
        at, yaw = snapshot.trace.position[0, own, :2], float(snapshot.trace.yaw[0, own])
        heads = slice(len(self._signals.link) - self._signals.walkers)
        sight = self._signals.position[heads, :2] - at
        ahead = sight @ heading_vectors(yaw)
        facing = heading_vectors(self._signals.yaw[heads]) @ heading_vectors(yaw) < -0.3
        narrow = np.abs(sight @ heading_vectors(yaw + np.pi / 2)) < ahead
        closed, amber = read_lights(snapshot)
        right, wrong = self._model.lights
        for row in np.flatnonzero((ahead > 3.0) & (ahead < LIGHTS_M) & facing & narrow).tolist():
            link, drawn = self._signals.link[row], float(self._random.uniform())
            letter = "y" if link in amber else "r" if link in closed else "G"
            if drawn < right:
                self._read[link] = (snapshot.time_s, letter)
            elif drawn < right + wrong:
                self._read[link] = (snapshot.time_s, "r" if letter == "G" else "G")


def sense_model(model: ErrorModel) -> Sensing:
    """Return what makes perception with the errors of a model, for `loop.drive`."""

    def sense(staged: Staged, seed: int) -> Perception:
        return ModelledPerception(model, staged, seed)

    return sense
