"""How well detections agree with the truth: AP and AOS per class, in 3D and bird's-eye, at IoU 0.5 and 0.7."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.perception.metrics import (
    average_precision,
    bootstrap_interval,
    match,
    orientation_similarity,
    right_headings,
)
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.detect import detect_all
from flcav.perception.objects.model import Second
from flcav.perception.objects.truth import ground_truth, in_range, only_lidar
from flcav.perception.ops.rotated import Kind
from flcav.progress import Report, silent
from flcav.records import Class
from flcav.seeds import stream
from flcav.sensors.frame import Frame
from flcav.world.weather import weather_class

OVERLAPS: tuple[tuple[Kind, float], ...] = (("3d", 0.5), ("3d", 0.7), ("bev", 0.5), ("bev", 0.7))
LOWEST_SCORE = 0.05  # detections below add nothing that the intervals would show


@dataclass(frozen=True)
class Asked:
    """What one frame holds for a network to find, LiDAR frame, detection classes."""

    scene: str
    targets: Boxes  # see `flcav.perception.objects.truth`
    neutral: Boxes  # finding them is neither right nor wrong; label = the class they are neutral for
    hidden: Boxes  # in range without a return: counted, not asked for
    occlusion: NDArray[np.float64] | None = None  # (targets,) share that is hidden, in [0, 1]; None: not known
    weather: str | None = None  # class of the frame's weather; None between the classes, and where it is not known


@dataclass(frozen=True)
class Score:
    """The result for one class under one measure of overlap; numbers are None where there was nothing to find."""

    label: Class
    kind: Kind
    iou: float  # that makes a detection a hit
    ap: float | None  # [0, 1]
    low: float | None  # 95 % interval over scenes; None where one scene holds all targets
    high: float | None
    aos: float | None  # average orientation similarity, [0, ap]
    right_headings: float | None  # share of found objects whose heading is off by less than 90 degrees
    targets: int  # objects asked for
    hidden: int  # objects in range without a single return


def asked_of(frame: Frame, config: SecondConfig) -> Asked:
    """Return what `frame` holds for a network of `config` to find: its targets.

    Faint and hidden objects, objects out of range and lookalikes are neutral.
    """
    truth = ground_truth(frame, config)
    neutral = (truth.known & ~truth.target) | truth.lookalike
    weather = None if frame.weather is None else weather_class(frame.weather)
    occlusion = frame.annotations.occlusion[truth.target].astype(float)
    boxes = truth.boxes
    return Asked(frame.scene, boxes[truth.target], boxes[neutral], boxes[truth.hidden], occlusion, weather)


def detections_and_truths(
    network: Second,
    frames: Iterable[Frame],
    asked: SecondConfig | None = None,
    *,
    total: int = 0,
    progress: Report = silent,
) -> tuple[list[Boxes], list[Asked]]:
    """Return what `network` finds in each frame, from `LOWEST_SCORE` on, and what there is to find.

    `asked`: a configuration of smaller range, beyond which no object is asked for and no detection counts.
    """
    truths: list[Asked] = []
    detections: list[Boxes] = []
    for done, frame in enumerate(frames, start=1):
        truths.append(asked_of(frame, asked or network.config))
        (found,) = detect_all(network, [frame.lidar[only_lidar(frame)]], score_threshold=LOWEST_SCORE)
        detections.append(found if asked is None else found[in_range(found, asked)])
        progress(done, max(total, done), "")
    return detections, truths


def score_detections(
    detections: Sequence[Boxes], truths: Sequence[Asked], classes: tuple[str, ...], *, seed: int = 0
) -> tuple[Score, ...]:
    """Return the scores of `detections` (LiDAR frame) against `truths`, frame by frame.

    Raises `InputError` where there are no frames.
    """
    if not truths:
        raise InputError("evaluation on 0 frames: at least one is wanted")
    scenes = tuple(truth.scene for truth in truths)
    scores = []
    for name in classes:
        found = [of_class(boxes, name) for boxes in detections]
        targets = [of_class(truth.targets, name) for truth in truths]
        neutral = [of_class(truth.neutral, name) for truth in truths]
        hidden = sum(len(of_class(truth.hidden, name)) for truth in truths)
        for kind, overlap in OVERLAPS:
            matches = match(found, targets, neutral, overlap, kind)
            low, high = bootstrap_interval(matches, scenes, rng=stream(seed, "bootstrap"))
            ap, aos, right = average_precision(matches), orientation_similarity(matches), right_headings(matches)
            numbers = map(number_or_none, (ap, low, high, aos, right))
            scores.append(Score(name, kind, overlap, *numbers, targets=sum(map(len, targets)), hidden=hidden))
    return tuple(scores)


def of_class(boxes: Boxes, name: str) -> Boxes:
    """Return the boxes of one class."""
    return boxes[boxes.label == name]


def number_or_none(value: float) -> float | None:
    """Return what JSON knows of a number that may be NaN."""
    return None if np.isnan(value) else round(value, 6)
