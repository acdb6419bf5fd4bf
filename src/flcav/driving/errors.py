"""Perception error model of the networks: perception of the same quality at a fraction of the computing time.

A perception error model (Piazzoni et al., "Modeling perception errors towards robust decision making in autonomous
vehicles", IJCAI 2020): road users in sight are detected with the measured probability for their class and distance,
with Gaussian errors of the measured standard deviation; lights and weather are read with the measured probabilities.
Detections are tracked and forecast like those of the networks. An actor stays detected or missed for `HELD_S`. False
positives are measured (`error_measurement`), but not modelled: the tracker does not report single ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, read_json
from flcav.driving.following import MOTIONS, Following, PathSpread
from flcav.driving.loop import Sensing
from flcav.driving.networks import LIGHTS_M, load_networks, load_road_map
from flcav.driving.obstacles import OBSTACLE
from flcav.driving.scenarios import StagedScenario
from flcav.driving.seen import (
    EGO,
    EYE_M,
    FIELD_M,
    TIMES_S,
    WEATHER_SPEED,
    Perception,
    Seen,
    find_around,
    read_actors,
    read_lights,
    share_seen,
)
from flcav.geometry import Array, Boxes, heading_vectors, rotate
from flcav.perception.objects.truth import DETECTION_CLASS
from flcav.statistics.streams import stream
from flcav.storage.records import Record
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot

EDGES_M = (0.0, 15.0, 30.0, 52.0)  # distances between which errors are measured
CLASSES = ("Car", "Pedestrian", "Cyclist", OBSTACLE)
SHIPPED = Path(__file__).parent / "shipped" / "errors.json"
MODELLED = "the model of errors"
HELD_S = 1.0  # for which an actor stays detected or missed
LIGHTS_S = 0.5  # between two readings of the lights


@dataclass(frozen=True)
class ErrorModel(Record):
    """Error model of the perception networks, as measured."""

    detected: Mapping[str, tuple[float, ...]]  # by class: recall of those in sight in each distance bin of `EDGES_M`
    # by class: of x, y [m] in the ego frame, and yaw [rad]; of obstacles outwards from their outline
    sd: Mapping[str, tuple[float, float, float]]
    false_positives: float  # per frame
    lights: tuple[float, float]  # share of the lights in the picture that are read correctly, and wrongly
    weather: Mapping[str, Mapping[str, float]]  # by true class: share of each predicted class
    spread_factor: float  # `PathSpread.factor`
    growth: Mapping[str, tuple[float, ...]]  # `PathSpread.growth` [m]
    seen: int  # road users in sight, over all frames
    frames: int

    @property
    def spread(self) -> PathSpread:
        """Return the calibrated uncertainty of tracks."""
        return PathSpread(self.spread_factor, self.growth)


def find_in_field(snapshot: Snapshot, scene: Scene) -> tuple[NDArray[np.int64], Boxes, Array]:
    """Return the road users in the detector's field and line of sight: rows of the trace, boxes, ego-frame positions.

    Boxes are in the world frame, labelled with detection classes, and those of no class, such as trucks, as `OBSTACLE`;
    positions (N, 2) [m] are ahead and to the left of the ego vehicle.
    """
    rows = find_around(snapshot, float(np.hypot(*FIELD_M)))
    boxes, _, _ = read_actors(snapshot, rows)
    ego = snapshot.row(EGO)
    at, yaw = snapshot.trace.position[0, ego], float(snapshot.trace.yaw[0, ego])
    x, y = rotate(boxes.center[:, 0] - at[0], boxes.center[:, 1] - at[1], -yaw)
    within = (x > 0) & (x < FIELD_M[0]) & (np.abs(y) < FIELD_M[1])
    rows, boxes, local = rows[within], boxes[within], np.stack((x, y), axis=1)[within]
    visible = share_seen(scene, at + np.array((0.0, 0.0, EYE_M)), boxes, ego) > 0
    labels = np.array([DETECTION_CLASS.get(label, OBSTACLE) for label in boxes.label[visible].tolist()], np.str_)
    kept = boxes[visible]
    return rows[visible], Boxes(kept.center, kept.size, kept.yaw, labels), local[visible]


def load_error_model(path: Path | None = None) -> ErrorModel:
    """Return the error model in a JSON file, by default that of the package; raises `InputError` for another file."""
    path = path or SHIPPED
    model = ErrorModel.from_json(read_json(path), str(path))
    if missing := [name for name in MOTIONS if len(model.growth.get(name, ())) != len(TIMES_S)]:
        raise InputError(f"{path}: no growth of '{missing[0]}' over {len(TIMES_S)} times; measure the errors again")
    if missing := [name for name in CLASSES if name not in model.detected or name not in model.sd]:
        raise InputError(f"{path}: no errors of '{missing[0]}'; measure the errors again")
    return model


class ModelledPerception:
    """Simulated perception: the ground truth with the errors of an error model."""

    def __init__(self, model: ErrorModel, staged: StagedScenario, seed: int) -> None:
        self._model = model
        self._scene = Scene(staged.town, staged.world.snapshot.trace)
        self._random = stream(seed, "errors", staged.scenario.name)
        self._following = Following(load_networks().trajectory, load_road_map(staged.scenario.town), model.spread)
        self._held: dict[str, tuple[float, float]] = {}
        self._read: dict[str, tuple[float, str]] = {}
        self._signals = staged.town.signals
        self._looked_s = -LIGHTS_S
        named = model.weather.get(staged.scenario.weather) or {staged.scenario.weather: 1.0}
        drawn = self._random.choice(list(named), p=list(named.values()))
        self._share = WEATHER_SPEED[str(drawn)]

    def look(self, snapshot: Snapshot) -> Seen:
        """Return a random draw of the networks' output at this instant."""
        self._scene.follow(snapshot.trace)
        self._read_lights(snapshot)
        closed = frozenset(n for n, (_, letter) in self._read.items() if letter != "G")
        amber = frozenset(n for n, (_, letter) in self._read.items() if letter == "y")
        tracks = self._following.step(self._detect(snapshot), snapshot.time_s, closed)
        return Seen(
            tracks.boxes, tracks.velocity, tracks.path, tracks.yaw, tracks.spread, closed, amber, self._share, MODELLED
        )

    def _detect(self, snapshot: Snapshot) -> Boxes:
        rows, boxes, local = find_in_field(snapshot, self._scene)
        names = snapshot.trace.actor[rows].tolist()
        bins = np.digitize(np.hypot(*local.T), EDGES_M[1:-1])
        chance = np.array([self._model.detected[str(c)][b] for c, b in zip(boxes.label, bins)])
        hit = np.array([self._hold(name, snapshot.time_s) for name in names]) < chance
        boxes = boxes[hit] if len(rows) else boxes
        sd = np.array([self._model.sd[str(c)] for c in boxes.label]).reshape(-1, 3)
        noise = self._random.normal(size=(len(boxes), 3)) * sd
        yaw = float(snapshot.trace.yaw[0, snapshot.row(EGO)])
        off = np.stack(rotate(noise[:, 0], noise[:, 1], yaw), axis=1)
        variance = np.concatenate((sd[:, :2] ** 2, np.full((len(boxes), 4), 0.04), sd[:, 2:] ** 2), axis=1)
        centre = boxes.center + np.pad(off, ((0, 0), (0, 1)))
        return Boxes(centre, boxes.size, boxes.yaw + noise[:, 2], boxes.label, np.full(len(boxes), 0.8), variance)

    def _hold(self, name: str, time_s: float) -> float:
        """Return the uniform number in [0, 1] that decides whether an actor is detected, drawn anew every `HELD_S`."""
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
        self._read = {link: read for link, read in self._read.items() if snapshot.time_s - read[0] <= 3.0}
        ego = snapshot.row(EGO)
        at, yaw = snapshot.trace.position[0, ego, :2], float(snapshot.trace.yaw[0, ego])
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
    """Return the constructor of a perception with the errors of a model, a `loop.Sensing`."""

    def sense(staged: StagedScenario, seed: int) -> Perception:
        return ModelledPerception(model, staged, seed)

    return sense
