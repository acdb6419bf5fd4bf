"""Multi-object tracking: a Kalman filter per object, and assignment by likelihood."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from flcav.geometry import Boxes, wrap_angle

Array = NDArray[np.float64]

MEASURED, STATES = 7, 9
YAW = 6
ACCELERATION = 3.0  # standard deviation [m/s^2]
DRIFT = np.array((0, 0, 0.2, 0.05, 0.05, 0.05, 0.3))  # of z, size and yaw [per root second]
FIRST_SPEED = 8.0  # standard deviation of a velocity of which nothing is known [m/s]
LEAST_VARIANCE = np.array((0.1, 0.1, 0.1, 0.2, 0.1, 0.1, 0.15)) ** 2  # of a detection's x, y, z, size, yaw


class State(NamedTuple):
    """What is known of one object."""

    mean: Array  # (9,)
    covariance: Array  # (9, 9)


def first_state(box: Array, variance: Array) -> State:
    """Return the state of an object seen once, as box (7,) with `variance` (7,); nothing is known of its velocity."""
    spread = np.concatenate((np.maximum(variance, LEAST_VARIANCE), np.full(2, FIRST_SPEED**2)))
    return State(np.concatenate((box, np.zeros(2))), np.diag(spread))


def predicted(state: State, after_s: float) -> State:
    """Return the state `after_s` later."""
    step = np.eye(STATES)
    step[0, 7] = step[1, 8] = after_s
    noise = np.zeros((STATES, STATES))
    noise[range(MEASURED), range(MEASURED)] = DRIFT**2 * after_s
    for place, speed in ((0, 7), (1, 8)):
        noise[place, place] += after_s**4 / 4
        noise[speed, speed] += after_s**2
        noise[place, speed] = noise[speed, place] = after_s**3 / 2
    both = np.ix_((0, 1, 7, 8), (0, 1, 7, 8))
    noise[both] *= ACCELERATION**2
    return State(step @ state.mean, step @ state.covariance @ step.T + noise)


def innovation(state: State, box: Array, variance: Array) -> tuple[Array, Array]:
    """Return how far box (7,) is from what `state` expects (7,), and the covariance of that (7, 7).

    A heading that is opposite to the expected one is taken for a mistake of the detector and turned.
    """
    off = box - state.mean[:MEASURED]
    turn = float(wrap_angle(off[YAW]))
    off[YAW] = turn if abs(turn) <= np.pi / 2 else float(wrap_angle(turn + np.pi))
    return off, state.covariance[:MEASURED, :MEASURED] + np.diag(np.maximum(variance, LEAST_VARIANCE))


def updated(state: State, box: Array, variance: Array) -> State:
    """Return the state after it was seen as box (7,) with `variance` (7,)."""
    off, spread = innovation(state, box, variance)
    gain = np.linalg.solve(spread, state.covariance[:MEASURED]).T
    mean = state.mean + gain @ off
    mean[YAW] = wrap_angle(mean[YAW])
    rest = np.eye(STATES)
    rest[:, :MEASURED] -= gain
    noise = np.diag(np.maximum(variance, LEAST_VARIANCE))
    return State(mean, rest @ state.covariance @ rest.T + gain @ noise @ gain.T)  # Joseph's form: stays symmetric


GATE = 9.21  # squared Mahalanobis distance in x, y that 99 % of true pairs stay below
FASTEST = 40.0  # [m/s] no pair is further apart than this allows
SLACK_M = 2.0
UNKNOWN_VARIANCE = np.array((0.3, 0.3, 0.2, 0.4, 0.15, 0.15, 0.2)) ** 2  # of detections that come without


@dataclass(frozen=True)
class Tracked:
    """The objects of one moment."""

    boxes: Boxes  # world frame; score: the mean of the track's detections so far; variance: the filter's
    track: NDArray[np.int64]  # (N,) each object's number, the same as long as it is followed
    velocity: Array  # (N, 2) along x and y of the world [m/s]


@dataclass
class _Track:
    number: int
    label: str
    state: State
    scores: list[float]
    missed: int = 0  # frames since it was last seen


class Tracker:
    """Follows objects of all classes through one sequence of frames.

    A track is told of from its `confirm`-th detection on, whenever it is seen, and ends after `patience` frames in
    which it was not.
    """

    def __init__(self, *, confirm: int = 2, patience: int = 3) -> None:
        self.confirm, self.patience = confirm, patience
        self._tracks: list[_Track] = []
        self._next = 0
        self._time_s: float | None = None

    def step(self, detections: Boxes, time_s: float) -> Tracked:
        """Return the objects followed after `detections` (world frame) at `time_s`, which must not run backwards."""
        after_s = 0.0 if self._time_s is None else time_s - self._time_s
        if after_s < 0:
            raise ValueError(f"frames must come in time order: {time_s} s after {self._time_s} s")
        first, self._time_s = self._time_s is None, time_s
        variance = detections.variance
        if variance is None:
            variance = np.tile(UNKNOWN_VARIANCE, (len(detections), 1))
        scores = np.ones(len(detections)) if detections.score is None else detections.score
        for track in self._tracks:
            track.state = predicted(track.state, after_s)
            track.missed += 1
        rows = detections.array()
        free = np.ones(len(rows), dtype=bool)
        for label in sorted({track.label for track in self._tracks}):
            tracks = [track for track in self._tracks if track.label == label]
            own = np.flatnonzero(detections.label == label)
            for t, d in assigned([track.state for track in tracks], rows[own], variance[own], after_s):
                track, number = tracks[t], own[d]
                track.state = updated(track.state, rows[number], variance[number])
                track.scores.append(float(scores[number]))
                track.missed = 0
                free[number] = False
        for number in np.flatnonzero(free):
            state = first_state(rows[number], variance[number])
            self._tracks.append(_Track(self._next, str(detections.label[number]), state, [float(scores[number])]))
            self._next += 1
        self._tracks = [track for track in self._tracks if track.missed <= self.patience]
        return self._told(first)

    def _told(self, first: bool) -> Tracked:
        told = [track for track in self._tracks if (len(track.scores) >= self.confirm or first) and track.missed == 0]
        mean = np.array([track.state.mean for track in told]).reshape(-1, 9)
        boxes = Boxes(
            mean[:, :3],
            mean[:, 3:6],
            mean[:, 6],
            np.array([track.label for track in told], dtype=np.str_),
            np.array([np.mean(track.scores) for track in told], dtype=np.float64),
            np.array([np.diag(track.state.covariance)[:7] for track in told]).reshape(-1, 7),
        )
        return Tracked(boxes, np.array([track.number for track in told], dtype=np.int64), mean[:, 7:])


def assigned(states: list[State], boxes: Array, variance: Array, after_s: float) -> list[tuple[int, int]]:
    """Return pairs (state, box) of least total cost, among those that the gate lets through; variance (D, 7)."""
    if not len(boxes) or not states:
        return []
    cost = np.full((len(states), len(boxes)), np.inf)
    for t, state in enumerate(states):
        reach = SLACK_M + FASTEST * after_s
        near = np.flatnonzero(np.hypot(*(boxes[:, :2] - state.mean[:2]).T) <= reach)
        for d in near:
            off, spread = innovation(state, boxes[d], variance[d])
            square = float(off[:2] @ np.linalg.solve(spread[:2, :2], off[:2]))
            if square <= GATE:
                cost[t, d] = square + np.linalg.slogdet(spread[:2, :2])[1]
    bound = 1e4
    pairs = zip(*linear_sum_assignment(np.where(np.isfinite(cost), cost, bound)), strict=True)
    return [(int(t), int(d)) for t, d in pairs if np.isfinite(cost[t, d])]
