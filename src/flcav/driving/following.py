"""Tracking and motion forecasts of detected road users, with calibrated uncertainty, as the input of the driver.

Tracks come from the tracker of the package, and are kept for `KEPT_S` without a detection. Vehicles that are known for
two seconds get the single path of the trajectory network, every half second; all others keep their velocity. Who moves
looks where it goes, also at speeds at which a track keeps the heading of its first detection: a detector often takes
the back of a car for its front.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.layout import FrameKey
from flcav.driving.seen import TIMES_S, predict_motion
from flcav.geometry import Array, Boxes, concatenate, heading_vectors, wrap_angle
from flcav.perception.tracking import Tracker
from flcav.perception.trajectory.config import FUTURE, PAST, STEP_S
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.predict import find_medoid, predict_paths
from flcav.perception.trajectory.rasters import RoadMap
from flcav.perception.trajectory.samples import Sample, extract_columns
from flcav.perception.trajectory.tracks import OFFSETS_S, Tracks, out_of_frame
from flcav.world.trace import Trace

KEPT_S = 0.45
EVERY_S = 0.5  # between two forecasts of a track
SLOW_MPS = 0.5  # below it the heading of a track is left as it is
MOVED_M = 1.0  # in two seconds: a track that moves less stands, whatever its velocity seems to be, and is not forecast
WALKS = "Pedestrian"
MOTIONS = ("stands", "drives", "forecast", "walks")  # whose paths are differently good; "forecast" is by the network
CATEGORY = {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "bicycle"}


def name_motion(label: str, velocity: Array, forecast: bool) -> str:
    """Return which of `MOTIONS` a track of a detection class has, with a forecast of the network or without."""
    if label == WALKS:
        return "walks"
    return "forecast" if forecast else "drives" if float(np.hypot(*velocity)) > 1.0 else "stands"


def head_forward(yaw: Array, velocity: Array) -> Array:
    """Return headings (N,) [rad], those turned by 180 degrees that are against a velocity (N, 2) above `SLOW_MPS`."""
    back = (heading_vectors(yaw) * velocity).sum(axis=1) < 0
    return np.asarray(wrap_angle(yaw + np.pi * (back & (np.linalg.norm(velocity, axis=1) > SLOW_MPS))))


@dataclass(frozen=True)
class PathSpread:
    """Calibrated uncertainty: factors of the variances of boxes, and the growth of the error of predicted paths."""

    factor: float = 1.0  # of the variances of tracked positions
    growth: Mapping[str, tuple[float, ...]] = field(
        default_factory=dict
    )  # by motion: deviation at `TIMES_S`, each axis [m]


CERTAIN = PathSpread()


Past = deque[tuple[float, float, float, float, float]]  # of a track: time [s], x, y [m], yaw [rad], speed [m/s]


@dataclass(frozen=True)
class Confirmed:
    """When a track is believed: found in `hits` of the last `sweeps`; until it has gone so far it stands."""

    hits: int = 3
    sweeps: int = 5
    sweep_s: float = 0.1
    drove_m: float = 1.5  # a box that is seen in part shifts by less
    walked_m: float = 0.5

    def holds(self, past: Past, time_s: float) -> bool:
        """Return whether a track has been found often enough lately."""
        since = time_s - (self.sweeps - 0.5) * self.sweep_s
        return sum(each[0] > since for each in past) >= self.hits

    def moves(self, past: Past, label: str) -> bool:
        """Return whether a track has gone far enough to be believed to move."""
        gone = float(np.hypot(past[-1][1] - past[0][1], past[-1][2] - past[0][2]))
        return gone > (self.walked_m if label == WALKS else self.drove_m)


CONFIRMED = Confirmed()


@dataclass(frozen=True)
class FollowedTracks:
    """Tracks at one instant with their forecasts, in the fields of `Seen`."""

    boxes: Boxes
    track: NDArray[np.int64]  # (N,)
    velocity: Array
    path: Array
    yaw: Array
    spread: Array
    motion: tuple[str, ...]  # (N,) of `MOTIONS`


@dataclass
class _Known:
    """What is known of a track: its last report, its past, and its last forecast."""

    box: Boxes
    velocity: Array
    seen_s: float
    past: Past
    forecast: Array | None = None  # (T, 2) at `forecast_s` + TIMES_S
    forecast_s: float = -1.0


class Following:
    """Follows detections through a drive; a network of None forecasts constant velocity for all."""

    def __init__(
        self,
        network: TrajectoryNetwork | None,
        roads: RoadMap | None,
        spread: PathSpread = CERTAIN,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Take the network of forecasts, the map, the uncertainty, and the rule by which tracks are believed."""
        self._tracker, self._known = Tracker(confirm=1 if confirmed else 2), dict[int, _Known]()
        self._network, self._roads, self._spread, self._confirmed = network, roads, spread, confirmed

    def step(self, found: Boxes, time_s: float, closed: frozenset[str]) -> FollowedTracks:
        """Return the tracks at `time_s` by the detections `found` (world frame) and the lights that are closed."""
        told = self._tracker.step(found, time_s)
        boxes = replace(told.boxes, yaw=head_forward(told.boxes.yaw, told.velocity))
        for row, number in enumerate(told.track.tolist()):
            box, velocity = boxes[[row]], told.velocity[row]
            known = self._known.setdefault(number, _Known(box, velocity, time_s, deque(maxlen=24)))
            known.box, known.velocity, known.seen_s = box, velocity, time_s
            speed = float(np.hypot(*velocity))
            known.past.append((time_s, *box.center[0, :2].tolist(), float(box.yaw[0]), speed))
        self._known = {n: each for n, each in self._known.items() if time_s - each.seen_s <= KEPT_S}
        if self._network is not None and self._roads is not None:
            self._forecast(self._network, self._roads, time_s, closed)
        return self._report(time_s)

    def _report(self, time_s: float) -> FollowedTracks:
        numbers = sorted(self._known)
        if self._confirmed is not None:
            numbers = [n for n in numbers if self._confirmed.holds(self._known[n].past, time_s)]
        rows = [self._known[n] for n in numbers]
        if not rows:
            none = np.zeros((0, len(TIMES_S)))
            return FollowedTracks(
                Boxes.empty(), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, len(TIMES_S), 2)), none, none, ()
            )
        boxes, velocity = concatenate([each.box for each in rows]), np.array([each.velocity for each in rows])
        if self._confirmed is not None:
            velocity[[not self._confirmed.moves(each.past, str(each.box.label[0])) for each in rows]] = 0.0
        path, yaw = predict_motion(boxes, velocity)
        late = time_s - np.array([each.seen_s for each in rows])
        path += (late[:, None] * velocity)[:, None]
        for row, each in enumerate(rows):
            if each.forecast is not None:
                path[row], yaw[row] = _shift(each, time_s, float(boxes.yaw[row]))
        motions = tuple(name_motion(str(each.box.label[0]), each.velocity, each.forecast is not None) for each in rows)
        growth = np.array([self._spread.growth.get(each, (0.0,) * len(TIMES_S)) for each in motions])
        now = np.zeros(len(rows)) if boxes.variance is None else boxes.variance[:, :2].mean(axis=1)
        spread = np.sqrt(self._spread.factor * now[:, None] + growth**2)
        return FollowedTracks(boxes, np.array(numbers, np.int64), velocity, path, yaw, spread, motions)

    def _forecast(self, network: TrajectoryNetwork, roads: RoadMap, time_s: float, closed: frozenset[str]) -> None:
        """Give the tracks that have a past of two seconds a new forecast, where their last one is old."""
        numbers, everybody = sorted(self._known), [self._known[n] for n in sorted(self._known)]
        due = np.array([_is_due(each, time_s) for each in everybody], np.bool_)
        if not due.any():
            return
        trace, tracks = _record(everybody, time_s, closed)
        key = FrameKey("live", 0, "ego", time_s)
        columns = extract_columns(trace, tracks, key, 0, roads, network.config.patch, due, complete=False)
        samples = [Sample(*row) for row in zip(*columns)]
        if not samples:
            return
        paths, shares = predict_paths(network, samples)
        single = paths[np.arange(len(paths)), find_medoid(paths, shares)]
        world = out_of_frame(single, columns.pose)
        for row, actor in enumerate(columns.actor.tolist()):
            each = self._known[numbers[actor]]
            each.forecast, each.forecast_s = _extend(columns.pose[row, :2], world[row]), time_s


def _is_due(each: _Known, time_s: float) -> bool:
    long = each.past[0][0] <= time_s - PAST * STEP_S + 0.15
    first, last = each.past[0], each.past[-1]
    moves = float(np.hypot(last[1] - first[1], last[2] - first[2])) > MOVED_M
    if not (long and moves) or str(each.box.label[0]) == WALKS:
        each.forecast = None
        return False
    return time_s - each.forecast_s > EVERY_S - 1e-6


def _extend(present: Array, path: Array) -> Array:
    """Return a forecast at `TIMES_S`: it begins at the present, and keeps its last velocity after its end."""
    whole = np.concatenate((present[None], path))
    beyond = np.arange(1, len(TIMES_S) - FUTURE)[:, None] * (path[-1] - path[-2])
    return np.concatenate((whole, path[-1] + beyond))[: len(TIMES_S)]


def _shift(each: _Known, time_s: float, yaw_now: float) -> tuple[Array, Array]:
    """Return a forecast (T, 2) moved to the present place of its track, and its headings (T,)."""
    assert each.forecast is not None
    age = time_s - each.forecast_s
    at = np.minimum(TIMES_S + age, TIMES_S[-1])
    path = np.stack([np.interp(at, TIMES_S, each.forecast[:, axis]) for axis in (0, 1)], axis=1)
    path += (TIMES_S + age - at)[:, None] * (each.forecast[-1] - each.forecast[-2]) / STEP_S
    path += each.box.center[0, :2] + (time_s - each.seen_s) * each.velocity - path[0]
    step = np.diff(path, axis=0, append=path[-1:] + path[-1:] - path[-2:-1])
    moves = np.hypot(*step.T) > 0.05
    return path, np.where(moves, np.arctan2(step[:, 1], step[:, 0]), yaw_now)


def _record(everybody: list[_Known], time_s: float, closed: frozenset[str]) -> tuple[Trace, Tracks]:
    """Return the tracks as the trajectory task reads them: a trace of the present, and the past at its instants."""
    count, times = len(everybody), time_s + OFFSETS_S
    position, yaw, speed = (
        np.full((len(times), count, 2), np.nan),
        *(np.full((len(times), count), np.nan) for _ in "ab"),
    )
    for actor, each in enumerate(everybody):
        past = np.array(each.past)
        own = np.flatnonzero((times <= time_s + 1e-6) & (times >= past[0, 0] - 0.15))
        position[own, actor] = np.stack([np.interp(times[own], past[:, 0], past[:, axis]) for axis in (1, 2)], axis=1)
        turned = np.unwrap(past[::-1, 3], period=np.pi)[::-1]  # either way round, to that of the present
        yaw[own, actor] = np.interp(times[own], past[:, 0], turned)
        speed[own, actor] = np.interp(times[own], past[:, 0], past[:, 4])
    links = sorted(closed)
    still = np.zeros((1, count, 3))
    trace = Trace(
        town="",
        time_s=np.array([time_s]),
        actor=np.array([f"track{row}" for row in range(count)], np.str_),
        category=np.array([CATEGORY[str(each.box.label[0])] for each in everybody], np.str_),
        shape=np.zeros(count, np.int64),
        size=np.concatenate([each.box.size for each in everybody]),
        present=np.ones((1, count), np.bool_),
        position=still,
        yaw=np.zeros((1, count)),
        velocity=still,
        acceleration=still,
        yaw_rate=np.zeros((1, count)),
        light=np.array(links, np.str_),
        light_state=np.full((1, len(links)), "r", "<U1"),
    )
    return trace, Tracks(position, yaw, speed)
