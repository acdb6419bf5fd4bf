"""Evaluation of multi-object tracking on recorded sequences: MOTA, AMOTA, identity switches, velocity error."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.foreground import frame_reader
from flcav.perception.metrics import round_or_none
from flcav.perception.metrics.matching import on_neutral
from flcav.perception.metrics.tracks import TrackingFrame, TrackScore, TracksEvaluation, amota, count_clear_mot
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.truth import choose_lidar, ground_truth, in_range
from flcav.perception.tracking.tracker import Tracked, Tracker
from flcav.sensors.frame import Frame

LONGEST_GAP_S = 1.0  # between two frames of a sequence
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

    A sequence is the frames (None: all) of one agent in one scene. Objects to be tracked are the targets of detection,
    by the network's configuration or by `asked`, one of smaller range.

    Raises `InputError` where consecutive frames of a sequence are more than `LONGEST_GAP_S` apart.
    """
    numbers, config = group_sequences(data, frames), asked or network.config
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
            (found,) = detect_in(network, [frame], score_threshold=SCORE)
            story.append((frame, tracker.step(found.transform(frame.world_from_sensor(lidar)), frame.time_s)))
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
    found: dict[tuple[str, str], list[int]] = defaultdict(list)
    for number in sorted(data.numbers(frames), key=lambda i: data.keys[i].time_s):
        found[data.keys[number].scene, data.keys[number].agent].append(number)
    for (scene, agent), numbers in found.items():
        gap = max(np.diff([data.keys[i].time_s for i in numbers]), default=0.0)
        if gap > LONGEST_GAP_S + 1e-6:
            apart = f"frames of {agent} in {scene} are {gap:g} s apart"
            raise InputError(f"{data.folder}: {apart}; tracks need {LONGEST_GAP_S:g} s at most")
    return found


def _final_scores(story: Sequence[Tracked]) -> dict[int, float]:
    """Return the score of each track in the last frame it is reported in, by its number."""
    final: dict[int, float] = {}
    for tracked in story:
        score = tracked.boxes.score if tracked.boxes.score is not None else np.ones(len(tracked.boxes))
        final |= dict(zip(tracked.track.tolist(), score.tolist(), strict=True))
    return final


def _moment(
    frame: Frame, tracked: Tracked, final: Mapping[int, float], config: SecondConfig, name: str
) -> tuple[TrackingFrame, list[float]]:
    """Return ground truth and tracks of class `name` in a frame, and velocity errors [m/s].

    There is one error for each track within 1 m of an object: that of the velocity in the plane, against the nearest
    object.
    """
    truth, annotations = ground_truth(frame, config), frame.annotations
    of_class = truth.boxes.label == name
    wanted = of_class & truth.target
    sensor_from_world = inverse(frame.world_from_sensor(choose_lidar(frame)))
    own = np.flatnonzero(tracked.boxes.label == name)
    own = own[in_range(tracked.boxes[own].transform(sensor_from_world), config)]
    boxes: Boxes = tracked.boxes[own]
    objects = np.flatnonzero(wanted)
    places, found = annotations.boxes.center[objects, :2], boxes.center[:, :2]
    moment = TrackingFrame(
        objects=annotations.track[objects],
        places=places,
        tracks=tracked.track[own],
        found=found,
        score=np.array([final[int(track)] for track in tracked.track[own]]),
        neutral=on_neutral(boxes, annotations.boxes[of_class & ~wanted]),
    )
    errors = []
    if len(objects) and len(own):
        apart = np.linalg.norm(places[:, None] - found[None], axis=2)
        nearest = apart.argmin(0)
        for number in np.flatnonzero(apart.min(0) <= 1.0):
            true = annotations.velocity[objects[nearest[number]]][:2]
            if np.isfinite(true).all():  # unknown in an imported dataset
                errors.append(float(np.linalg.norm(true - tracked.velocity[own[number]])))
    return moment, errors
