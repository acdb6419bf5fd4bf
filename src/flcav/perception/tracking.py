"""Multi-object tracking (AB3DMOT): a Kalman filter per object, Hungarian assignment by likelihood, and its evaluation.

The state is x, y, z, length, width, height, yaw, then the velocity along x and y: that of Weng et al., "3D Multi-Object
Tracking: A Baseline and New Evaluation Metrics", IROS 2020, sec. III-B, without a vertical velocity. The motion model
is constant velocity in the plane; height, size and yaw are random walks. The process noise is that of white
acceleration, so that the time between frames may vary (Bar-Shalom et al., "Estimation with Applications to Tracking and
Navigation", 2001, eq. 6.3.2-4).

The cost of pairing a track with a detection is the negative log-likelihood of the detection under the prediction, and
pairs outside a gate are excluded (Chiu et al., "Probabilistic 3D Multi-Object Tracking for Autonomous Driving", 2020),
so that the variances predicted by a detector count.

Detectors confuse front and rear: a track takes its axis from all detections, but its direction from the first one until
it moves. A track that moves backwards is turned by 180 degrees, see `head_with_motion`.

Recorded sequences are evaluated by MOTA, AMOTA, identity switches and velocity error (`flcav.perception.metrics`).
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from flcav.arrays import Array, Ints
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse, wrap_angle
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.agents import frame_reader
from flcav.perception.metrics import round_or_none
from flcav.perception.metrics.detection import on_neutral
from flcav.perception.metrics.tracks import TrackingFrame, TrackScore, TracksEvaluation, amota, count_clear_mot
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.truth import choose_lidar, ground_truth, in_range
from flcav.sensors.frame import Frame

MEASURED, STATES = 7, 9  # lengths of a measurement and of a state
YAW = 6  # index in both
ACCELERATION = 3.0  # standard deviation of the white acceleration [m/s^2]
DRIFT = np.array((0, 0, 0.2, 0.05, 0.05, 0.05, 0.3))  # of the random walks of z, size [m/sqrt(s)] and yaw [rad/sqrt(s)]
FIRST_SPEED = 8.0  # standard deviation of the velocity of a new track [m/s]
LEAST_VARIANCE = np.array((0.1, 0.1, 0.1, 0.2, 0.1, 0.1, 0.15)) ** 2  # of a detection: x, y, z, size [m^2], yaw [rad^2]
GATE = 9.21  # largest squared Mahalanobis distance in x, y of a pair: 99 % quantile of chi-squared with 2 dof
FASTEST = 40.0  # [m/s] a pair is at most this speed times the elapsed time plus `SLACK_M` apart
SLACK_M = 2.0
REVERSING_MPS = 3.0  # largest speed at which a vehicle backs up
REVERSED_M = 6.0  # longest distance that a vehicle backs up while manoeuvring
SURE_M = 1.0  # distance moved backwards from which a speed is believed; also the limit for pedestrians and cyclists
VEHICLE_M = 2.5  # length from which an object is a vehicle that may back up
UNKNOWN_VARIANCE = np.array((0.3, 0.3, 0.2, 0.4, 0.15, 0.15, 0.2)) ** 2  # for detections without a predicted one


class TrackState(NamedTuple):
    """Gaussian state estimate of an object: x, y, z, length, width, height [m], yaw [rad], velocity x, y [m/s]."""

    mean: Array  # (9,)
    covariance: Array  # (9, 9)


def start_state(box: Array, variance: Array) -> TrackState:
    """Return the state of a new track from its first detection, box (7,) with `variance` (7,); zero mean velocity."""
    spread = np.concatenate((np.maximum(variance, LEAST_VARIANCE), np.full(2, FIRST_SPEED**2)))
    return TrackState(np.concatenate((box, np.zeros(2))), np.diag(spread))


def predict_state(state: TrackState, after_s: float) -> TrackState:
    """Return the Kalman prediction of the state `after_s` [s] later, at constant velocity."""
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
    return TrackState(step @ state.mean, step @ state.covariance @ step.T + noise)


def innovation(state: TrackState, box: Array, variance: Array) -> tuple[Array, Array]:
    """Return the innovation (7,) of a box (7,) with `variance` (7,), and its covariance (7, 7).

    The innovation is the detection minus the prediction. A heading more than 90 degrees from the predicted one is taken
    as reversed by the detector, and turned by 180 degrees.
    """
    off = box - state.mean[:MEASURED]
    turn = float(wrap_angle(off[YAW]))
    off[YAW] = turn if abs(turn) <= np.pi / 2 else float(wrap_angle(turn + np.pi))
    return off, state.covariance[:MEASURED, :MEASURED] + np.diag(np.maximum(variance, LEAST_VARIANCE))


def update_state(state: TrackState, box: Array, variance: Array) -> TrackState:
    """Return the Kalman update of the state by the detection box (7,) with `variance` (7,)."""
    off, spread = innovation(state, box, variance)
    gain = np.linalg.solve(spread, state.covariance[:MEASURED]).T
    mean = state.mean + gain @ off
    mean[YAW] = wrap_angle(mean[YAW])
    rest = np.eye(STATES)
    rest[:, :MEASURED] -= gain
    noise = np.diag(np.maximum(variance, LEAST_VARIANCE))
    return TrackState(mean, rest @ state.covariance @ rest.T + gain @ noise @ gain.T)  # Joseph form: stays symmetric


def head_with_motion(state: TrackState, ahead_m: float, after_s: float) -> tuple[TrackState, float]:
    """Return the state, turned by 180 degrees where its motion contradicts its heading, and the distance ahead [m].

    `ahead_m` is the distance that the object went along its heading before the last `after_s` [s], negative backwards.
    The heading is wrong once a vehicle has moved backwards farther than vehicles back up (`REVERSED_M`), or does so
    faster than they do (`REVERSING_MPS`, by two standard deviations); a vehicle that backs up briefly keeps it.
    """
    heading = np.array((np.cos(state.mean[YAW]), np.sin(state.mean[YAW])))
    speed = float(heading @ state.mean[MEASURED:])
    doubt = 2 * float(np.sqrt(heading @ state.covariance[MEASURED:, MEASURED:] @ heading))
    most_m = REVERSED_M if state.mean[3] >= VEHICLE_M else SURE_M
    ahead_m = min(ahead_m + speed * after_s, most_m)
    if ahead_m >= -most_m and (ahead_m >= -SURE_M or speed + doubt >= -REVERSING_MPS):
        return state, ahead_m
    turned = state.mean.copy()
    turned[YAW] = wrap_angle(turned[YAW] + np.pi)
    return TrackState(turned, state.covariance), min(-ahead_m, most_m)


@dataclass(frozen=True)
class Tracked:
    """The N tracks seen in a frame."""

    boxes: Boxes  # world frame; score: mean over the track's detections so far; variance: of the Kalman filter
    track: Ints  # (N,) number of each track, constant over its life
    velocity: Array  # (N, 2) along x and y of the world [m/s]


@dataclass
class _Track:
    number: int
    label: str
    state: TrackState
    scores: list[float]  # of its detections
    missed: int = 0  # frames since its last detection
    ahead_m: float = 0.0  # distance along its heading [m], see `head_with_motion`
    seen_s: float = 0.0  # time of its last detection [s]


class Tracker:
    """Multi-object tracker of all classes through one sequence of frames.

    A track is reported in a frame with a detection of it, from its `confirm`-th detection on; in the first frame all
    tracks are. It ends once it has had no detection for more than `patience` consecutive frames.
    """

    def __init__(self, *, confirm: int = 2, patience: int = 3) -> None:
        self.confirm, self.patience = confirm, patience
        self._tracks: list[_Track] = []
        self._next = 0
        self._time_s: float | None = None

    def step(self, detections: Boxes, time_s: float) -> Tracked:
        """Return the tracks seen at `time_s`: predict, assign `detections` (world frame), update, begin and end tracks.

        Detections without scores count with score 1, those without variances with `UNKNOWN_VARIANCE`. Raises ValueError
        where `time_s` [s] is before that of the last step.
        """
        after_s = 0.0 if self._time_s is None else time_s - self._time_s
        if after_s < 0:
            raise ValueError(f"frames must come in time order: {time_s} s after {self._time_s} s")
        first = self._time_s is None
        self._time_s = time_s
        variance = detections.variance
        if variance is None:
            variance = np.tile(UNKNOWN_VARIANCE, (len(detections), 1))
        scores = np.ones(len(detections)) if detections.score is None else detections.score
        for track in self._tracks:
            track.state = predict_state(track.state, after_s)
            track.missed += 1
        rows = detections.array()
        free = np.ones(len(rows), dtype=bool)
        for label in sorted({track.label for track in self._tracks}):
            tracks = [track for track in self._tracks if track.label == label]
            same = np.flatnonzero(detections.label == label)
            for t, d in associate_detections([track.state for track in tracks], rows[same], variance[same], after_s):
                track = tracks[t]
                number = same[d]
                state = update_state(track.state, rows[number], variance[number])
                track.state, track.ahead_m = head_with_motion(state, track.ahead_m, time_s - track.seen_s)
                track.seen_s = time_s
                track.scores.append(float(scores[number]))
                track.missed = 0
                free[number] = False
        for number in np.flatnonzero(free):
            state = start_state(rows[number], variance[number])
            first_scores = [float(scores[number])]
            self._tracks.append(_Track(self._next, str(detections.label[number]), state, first_scores, seen_s=time_s))
            self._next += 1
        self._tracks = [track for track in self._tracks if track.missed <= self.patience]
        return self._report(first)

    def _report(self, first: bool) -> Tracked:
        reported = [
            track for track in self._tracks if (len(track.scores) >= self.confirm or first) and track.missed == 0
        ]
        mean = np.array([track.state.mean for track in reported]).reshape(-1, 9)
        boxes = Boxes(
            mean[:, :3],
            mean[:, 3:6],
            mean[:, 6],
            np.array([track.label for track in reported], dtype=np.str_),
            np.array([np.mean(track.scores) for track in reported], dtype=np.float64),
            np.array([np.diag(track.state.covariance)[:7] for track in reported]).reshape(-1, 7),
        )
        return Tracked(boxes, np.array([track.number for track in reported], dtype=np.int64), mean[:, 7:])


def associate_detections(
    states: list[TrackState], boxes: Array, variance: Array, after_s: float
) -> list[tuple[int, int]]:
    """Return the pairs (index of a state, index of a box) of least total cost, by the Hungarian method within the gate.

    The cost is twice the negative log-likelihood of the detection's x, y under the prediction, up to a constant.
    `boxes` and `variance` are (D, 7); `after_s` is the time since the last step [s].
    """
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


LONGEST_GAP_S = 1.0  # longest time between two frames of a sequence
SCORE = 0.3  # lowest score of a detection that is tracked


def evaluate_tracks(
    network: Second,
    data: Dataset,
    frames: Sequence[int] | None = None,
    *,
    asked: SecondConfig | None = None,
    progress: Report = ignore_progress,
) -> TracksEvaluation:
    """Return MOTA, AMOTA, identity switches and velocity error per class.

    A sequence consists of the frames (None: all) of one agent in one scene. Objects to track are the targets of
    detection, by the network's configuration or by `asked`, a configuration of smaller range. Raises `InputError` where
    consecutive frames of a sequence are more than `LONGEST_GAP_S` apart.
    """
    numbers = group_sequences(data, frames)
    config = asked or network.config
    total = sum(map(len, numbers.values()))
    per_class: dict[str, list[list[TrackingFrame]]] = {name: [] for name in network.config.classes}
    speed_errors: dict[str, list[float]] = {name: [] for name in network.config.classes}
    read, done = frame_reader(data, network.config.foreground), 0
    for sequence in numbers.values():
        tracker = Tracker()
        story: list[tuple[Frame, Tracked]] = []
        for number in sequence:
            frame = read(number)
            lidar = choose_lidar(frame)
            (detected,) = detect_in(network, [frame], score_threshold=SCORE)
            story.append((frame, tracker.step(detected.transform(frame.world_from_sensor(lidar)), frame.time_s)))
            done += 1
            progress(done, total, "")
        final = _final_scores([tracked for _, tracked in story])
        for name in per_class:
            moments = [_moment(frame, tracked, final, config, name) for frame, tracked in story]
            per_class[name].append([moment for moment, _ in moments])
            speed_errors[name] += [error for _, errors in moments for error in errors]
    rows = []
    for name, moments in per_class.items():
        counts = count_clear_mot(moments)
        rows.append(
            TrackScore(
                name,
                objects=counts.objects,
                mota=round_or_none(counts.mota),
                amota=round_or_none(amota(moments)),
                motp_m=round_or_none(counts.motp_m),
                misses=counts.misses,
                false_positives=counts.false_positives,
                id_switches=counts.switches,
                velocity_error_mps=round_or_none(float(np.mean(speed_errors[name] or [np.nan]))),
            )
        )
    return TracksEvaluation(len(numbers), total, tuple(rows))


def group_sequences(data: Dataset, frames: Sequence[int] | None = None) -> dict[tuple[str, str], list[int]]:
    """Return the numbers of the frames (None: all) by (scene, agent), in time order.

    Raises `InputError` where consecutive frames of a sequence are more than `LONGEST_GAP_S` apart.
    """
    sequences: dict[tuple[str, str], list[int]] = defaultdict(list)
    for number in sorted(data.numbers(frames), key=lambda i: data.keys[i].time_s):
        sequences[data.keys[number].scene, data.keys[number].agent].append(number)
    for (scene, agent), numbers in sequences.items():
        gap = max(np.diff([data.keys[i].time_s for i in numbers]), default=0.0)
        if gap > LONGEST_GAP_S + 1e-6:
            apart = f"frames of {agent} in {scene} are {gap:g} s apart"
            raise InputError(f"{data.folder}: {apart}; tracks need {LONGEST_GAP_S:g} s at most")
    return sequences


def _final_scores(story: Sequence[Tracked]) -> dict[int, float]:
    """Return the score of each track in the last frame in which it is reported, by its number."""
    final: dict[int, float] = {}
    for tracked in story:
        score = tracked.boxes.score if tracked.boxes.score is not None else np.ones(len(tracked.boxes))
        final |= dict(zip(tracked.track.tolist(), score.tolist(), strict=True))
    return final


def _moment(
    frame: Frame, tracked: Tracked, final: Mapping[int, float], config: SecondConfig, name: str
) -> tuple[TrackingFrame, list[float]]:
    """Return ground truth and tracks of class `name` in a frame, and velocity errors [m/s].

    There is one error per track within 1 m of an object: that of the velocity in the plane, relative to the nearest
    object.
    """
    truth, annotations = ground_truth(frame, config), frame.annotations
    of_class = truth.boxes.label == name
    wanted = of_class & truth.target
    sensor_from_world = inverse(frame.world_from_sensor(choose_lidar(frame)))
    rows = np.flatnonzero(tracked.boxes.label == name)
    rows = rows[in_range(tracked.boxes[rows].transform(sensor_from_world), config)]
    boxes: Boxes = tracked.boxes[rows]
    objects = np.flatnonzero(wanted)
    places = annotations.boxes.center[objects, :2]
    found = boxes.center[:, :2]
    moment = TrackingFrame(
        objects=annotations.track[objects],
        places=places,
        tracks=tracked.track[rows],
        found=found,
        score=np.array([final[int(track)] for track in tracked.track[rows]]),
        neutral=on_neutral(boxes, annotations.boxes[of_class & ~wanted]),
    )
    errors = []
    if len(objects) and len(rows):
        apart = np.linalg.norm(places[:, None] - found[None], axis=2)
        nearest = apart.argmin(0)
        for number in np.flatnonzero(apart.min(0) <= 1.0):
            true = annotations.velocity[objects[nearest[number]]][:2]
            if np.isfinite(true).all():  # unknown in an imported dataset
                errors.append(float(np.linalg.norm(true - tracked.velocity[rows[number]])))
    return moment, errors
