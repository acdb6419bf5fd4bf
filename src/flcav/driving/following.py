"""Tracking and motion forecasts of detected road users, with calibrated uncertainty, as the input of the driver.

Tracks are kept for `KEPT_S` without a detection. Vehicles that have been tracked for two seconds get the medoid path of
the trajectory network every half second; all others keep their velocity. Headings of moving tracks are turned to the
direction of motion, even at speeds at which the tracker keeps the heading of the first detection: detectors often
confuse the rear of a car with its front.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.layout import FrameKey
from flcav.driving.obstacles import OBSTACLE
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

KEPT_S = 0.45  # for which a track is kept without a detection
EVERY_S = 0.5  # between two forecasts of a track
SLOW_MPS = 0.5  # below it the heading of a track is kept
MOVED_M = 1.0  # in two seconds: a track that moves less counts as standing, despite a noisy velocity
WALKS = "Pedestrian"
MOTIONS = ("stands", "drives", "forecast", "walks")  # kinds of paths by their error; "forecast" is by the network
AFOOT_M = 1.2  # length below which a box may be of somebody on foot
CATEGORY = {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "bicycle", OBSTACLE: "truck"}


def name_motion(label: str, velocity: Array, forecast: bool) -> str:
    """Return the kind of motion (of `MOTIONS`) of a track, by its detection class and velocity (2,) [m/s]."""
    if label == WALKS:
        return "walks"
    return "forecast" if forecast else "drives" if float(np.hypot(*velocity)) > 1.0 else "stands"


def head_forward(yaw: Array, velocity: Array) -> Array:
    """Return headings (N,) [rad], turned by 180 degrees where they oppose a velocity (N, 2) [m/s] above `SLOW_MPS`."""
    back = (heading_vectors(yaw) * velocity).sum(axis=1) < 0
    return np.asarray(wrap_angle(yaw + np.pi * (back & (np.linalg.norm(velocity, axis=1) > SLOW_MPS))))


@dataclass(frozen=True)
class PathSpread:
    """Calibrated uncertainty of predicted paths: a factor on the tracks' variances, and the growth of the error."""

    factor: float = 1.0  # on the variances of tracked positions
    growth: Mapping[str, tuple[float, ...]] = field(
        default_factory=dict
    )  # by motion: standard deviation per axis at `TIMES_S` [m]


CERTAIN = PathSpread()


Past = deque[tuple[float, float, float, float, float]]  # of a track: time [s], x, y [m], yaw [rad], speed [m/s]


@dataclass(frozen=True)
class Confirmed:
    """Confirmation rule of tracks: detected in `hits` of the last `sweeps`; stationary until moved by a distance."""

    hits: int = 3
    sweeps: int = 5
    sweep_s: float = 0.1  # between two sweeps
    drove_m: float = 1.5  # a partly occluded box shifts by less without moving
    walked_m: float = 0.5  # for pedestrians, and for what is as small

    def holds(self, past: Past, time_s: float) -> bool:
        """Return whether a track is confirmed at `time_s` [s]."""
        since = time_s - (self.sweeps - 0.5) * self.sweep_s
        return sum(report[0] > since for report in past) >= self.hits

    def moves(self, past: Past, box: Boxes) -> bool:
        """Return whether a track whose last box is `box` (1,) has moved far enough to count as moving."""
        moved = float(np.hypot(past[-1][1] - past[0][1], past[-1][2] - past[0][2]))
        return moved > (self.walked_m if box.label[0] == WALKS or box.size[0, :2].max() < AFOOT_M else self.drove_m)


CONFIRMED = Confirmed()


@dataclass(frozen=True)
class FollowedTracks:
    """N tracks at one instant with their forecasts at T times (`TIMES_S`), in the world frame; fields as in `Seen`."""

    boxes: Boxes
    track: NDArray[np.int64]  # (N,)
    velocity: Array  # (N, 2) [m/s]
    path: Array  # (N, T, 2) [m]
    yaw: Array  # (N, T) [rad]
    spread: Array  # (N, T) standard deviation per axis [m]
    motion: tuple[str, ...]  # (N,) of `MOTIONS`


@dataclass
class _Known:
    """State of a track: its last report, its past, and its last forecast."""

    box: Boxes
    velocity: Array
    seen_s: float
    past: Past
    forecast: Array | None = None  # (T, 2) at `forecast_s` + TIMES_S
    forecast_s: float = -1.0


class Following:
    """Tracker and forecaster of a drive; without a network all paths are of constant velocity."""

    def __init__(
        self,
        network: TrajectoryNetwork | None,
        roads: RoadMap | None,
        spread: PathSpread = CERTAIN,
        confirmed: Confirmed = CONFIRMED,
    ) -> None:
        """Take the trajectory network, the road map, the calibrated uncertainty, and the confirmation rule."""
        self._tracker = Tracker(confirm=1)  # `confirmed` is the stricter rule
        self._known = dict[int, _Known]()
        self._network, self._roads = network, roads
        self._spread, self._confirmed = spread, confirmed

    def step(self, found: Boxes, time_s: float, closed: frozenset[str]) -> FollowedTracks:
        """Update the tracks with the detections `found` (world frame) at `time_s` [s], and return them.

        `closed` are the names of the lights that are not green.
        """
        tracked = self._tracker.step(found, time_s)
        boxes = replace(tracked.boxes, yaw=head_forward(tracked.boxes.yaw, tracked.velocity))
        for row, number in enumerate(tracked.track.tolist()):
            box, velocity = boxes[[row]], tracked.velocity[row]
            known = self._known.setdefault(number, _Known(box, velocity, time_s, deque(maxlen=24)))
            known.box, known.velocity, known.seen_s = box, velocity, time_s
            speed = float(np.hypot(*velocity))
            known.past.append((time_s, *box.center[0, :2].tolist(), float(box.yaw[0]), speed))
        self._known = {n: known for n, known in self._known.items() if time_s - known.seen_s <= KEPT_S}
        if self._network is not None and self._roads is not None:
            self._forecast(self._network, self._roads, time_s, closed)
        return self._report(time_s)

    def _report(self, time_s: float) -> FollowedTracks:
        numbers = [n for n in sorted(self._known) if self._confirmed.holds(self._known[n].past, time_s)]
        rows = [self._known[n] for n in numbers]
        if not rows:
            none = np.zeros((0, len(TIMES_S)))
            return FollowedTracks(
                Boxes.empty(), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, len(TIMES_S), 2)), none, none, ()
            )
        boxes, velocity = concatenate([track.box for track in rows]), np.array([track.velocity for track in rows])
        velocity[[not self._confirmed.moves(track.past, track.box) for track in rows]] = 0.0
        path, yaw = predict_motion(boxes, velocity)
        late = time_s - np.array([track.seen_s for track in rows])
        path += (late[:, None] * velocity)[:, None]
        for row, track in enumerate(rows):
            if track.forecast is not None:
                path[row], yaw[row] = _shift(track, time_s, float(boxes.yaw[row]))
        motions = tuple(
            name_motion(str(track.box.label[0]), track.velocity, track.forecast is not None) for track in rows
        )
        growth = np.array([self._spread.growth.get(motion, (0.0,) * len(TIMES_S)) for motion in motions])
        now = np.zeros(len(rows)) if boxes.variance is None else boxes.variance[:, :2].mean(axis=1)
        spread = np.sqrt(self._spread.factor * now[:, None] + growth**2)
        return FollowedTracks(boxes, np.array(numbers, np.int64), velocity, path, yaw, spread, motions)

    def _forecast(self, network: TrajectoryNetwork, roads: RoadMap, time_s: float, closed: frozenset[str]) -> None:
        """Renew the forecasts older than `EVERY_S`, of the tracks with a past of two seconds."""
        numbers = sorted(self._known)
        everybody = [self._known[n] for n in numbers]
        due = np.array([_is_due(track, time_s) for track in everybody], np.bool_)
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
            track = self._known[numbers[actor]]
            track.forecast, track.forecast_s = _extend(columns.pose[row, :2], world[row]), time_s


def _is_due(track: _Known, time_s: float) -> bool:
    long = track.past[0][0] <= time_s - PAST * STEP_S + 0.15
    first, last = track.past[0], track.past[-1]
    moves = float(np.hypot(last[1] - first[1], last[2] - first[2])) > MOVED_M
    if not (long and moves) or str(track.box.label[0]) == WALKS:
        track.forecast = None
        return False
    return time_s - track.forecast_s > EVERY_S - 1e-6


def _extend(present: Array, path: Array) -> Array:
    """Return a forecast (T, 2) at `TIMES_S`, from the present place on; the last velocity goes on beyond its end."""
    whole = np.concatenate((present[None], path))
    beyond = np.arange(1, len(TIMES_S) - FUTURE)[:, None] * (path[-1] - path[-2])
    return np.concatenate((whole, path[-1] + beyond))[: len(TIMES_S)]


def _shift(track: _Known, time_s: float, yaw_now: float) -> tuple[Array, Array]:
    """Return a forecast (T, 2) [m] shifted to the present place of its track, and its headings (T,) [rad]."""
    assert track.forecast is not None
    age = time_s - track.forecast_s
    at = np.minimum(TIMES_S + age, TIMES_S[-1])
    path = np.stack([np.interp(at, TIMES_S, track.forecast[:, axis]) for axis in (0, 1)], axis=1)
    path += (TIMES_S + age - at)[:, None] * (track.forecast[-1] - track.forecast[-2]) / STEP_S
    path += track.box.center[0, :2] + (time_s - track.seen_s) * track.velocity - path[0]
    step = np.diff(path, axis=0, append=path[-1:] + path[-1:] - path[-2:-1])
    moves = np.hypot(*step.T) > 0.05
    return path, np.where(moves, np.arctan2(step[:, 1], step[:, 0]), yaw_now)


def _record(everybody: list[_Known], time_s: float, closed: frozenset[str]) -> tuple[Trace, Tracks]:
    """Return the tracks as input of the trajectory task: a trace of the present, and the past at `OFFSETS_S`."""
    count, times = len(everybody), time_s + OFFSETS_S
    position, yaw, speed = (
        np.full((len(times), count, 2), np.nan),
        *(np.full((len(times), count), np.nan) for _ in "ab"),
    )
    for actor, track in enumerate(everybody):
        past = np.array(track.past)
        known = np.flatnonzero((times <= time_s + 1e-6) & (times >= past[0, 0] - 0.15))
        position[known, actor] = np.stack(
            [np.interp(times[known], past[:, 0], past[:, axis]) for axis in (1, 2)], axis=1
        )
        turned = np.unwrap(past[::-1, 3], period=np.pi)[::-1]  # headings are ambiguous by pi: aligned to the present
        yaw[known, actor] = np.interp(times[known], past[:, 0], turned)
        speed[known, actor] = np.interp(times[known], past[:, 0], past[:, 4])
    links = sorted(closed)
    still = np.zeros((1, count, 3))
    trace = Trace(
        town="",
        time_s=np.array([time_s]),
        actor=np.array([f"track{row}" for row in range(count)], np.str_),
        category=np.array([CATEGORY[str(track.box.label[0])] for track in everybody], np.str_),
        shape=np.zeros(count, np.int64),
        size=np.concatenate([track.box.size for track in everybody]),
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
