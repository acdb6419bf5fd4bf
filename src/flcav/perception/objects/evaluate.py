"""Evaluation of detections against ground truth: AP and AOS per class, 3D and bird's-eye view, at IoU 0.5 and 0.7."""

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
from flcav.perception.objects.truth import choose_lidar, ground_truth, in_range
from flcav.perception.ops.rotated import Kind
from flcav.progress import Report, ignore_progress
from flcav.records import Class
from flcav.seeds import stream
from flcav.sensors.frame import Frame
from flcav.world.weather import classify_weather

OVERLAPS: tuple[tuple[Kind, float], ...] = (("3d", 0.5), ("3d", 0.7), ("bev", 0.5), ("bev", 0.7))
LOWEST_SCORE = 0.05  # of detections that are evaluated; lower ones change AP by less than its interval


@dataclass(frozen=True)
class FrameTruth:
    """Ground truth of one frame for evaluation: targets, neutral and hidden objects, LiDAR frame, detection classes."""

    scene: str
    targets: Boxes  # see `flcav.perception.objects.truth`
    neutral: Boxes  # a detection on them is neither true nor false; label = the class they are neutral for
    hidden: Boxes  # in range without a return: counted, and neutral too
    occlusion: NDArray[np.float64] | None = None  # (targets,) occluded share in [0, 1]; None: not known
    weather: str | None = None  # weather class of the frame; None between the classes, and where it is not known


@dataclass(frozen=True)
class Score:
    """AP and AOS of one class for one kind of overlap and IoU threshold; None where there are no targets."""

    label: Class
    kind: Kind
    iou: float  # from which a detection is a true positive
    ap: float | None  # average precision AP|R40, [0, 1]
    low: float | None  # 95 % interval of AP over scenes; None where one scene holds all targets
    high: float | None
    aos: float | None  # average orientation similarity, [0, ap]
    right_headings: float | None  # share of true positives with a heading error below 90 degrees; None without any
    targets: int
    hidden: int  # objects in range without a return


def asked_of(frame: Frame, config: SecondConfig) -> FrameTruth:
    """Return the targets, neutral and hidden objects of `frame` for the evaluation of a network of `config`.

    Faint and hidden objects, objects out of range and lookalikes are neutral. Raises `InputError` where the frame has
    no LiDAR.
    """
    truth = ground_truth(frame, config)
    neutral = (truth.known & ~truth.target) | truth.lookalike
    weather = None if frame.weather is None else classify_weather(frame.weather)
    occlusion = frame.annotations.occlusion[truth.target].astype(float)
    boxes = truth.boxes
    return FrameTruth(frame.scene, boxes[truth.target], boxes[neutral], boxes[truth.hidden], occlusion, weather)


def detect_frames(
    network: Second,
    frames: Iterable[Frame],
    asked: SecondConfig | None = None,
    *,
    total: int = 0,
    progress: Report = ignore_progress,
) -> tuple[list[Boxes], list[FrameTruth]]:
    """Return the detections of `network` in each frame, from `LOWEST_SCORE` on, and the ground truth of each frame.

    asked: a configuration of smaller range (None: the network's own); objects beyond it are neutral, and detections
    beyond it are dropped. total: number of frames where it is known, for `progress`. Raises `InputError` where a frame
    has no LiDAR.
    """
    truths: list[FrameTruth] = []
    detections: list[Boxes] = []
    for done, frame in enumerate(frames, start=1):
        truths.append(asked_of(frame, asked or network.config))
        (found,) = detect_all(network, [frame.lidar[choose_lidar(frame)]], score_threshold=LOWEST_SCORE)
        detections.append(found if asked is None else found[in_range(found, asked)])
        progress(done, max(total, done), "")
    return detections, truths


def score_detections(
    detections: Sequence[Boxes], truths: Sequence[FrameTruth], classes: tuple[str, ...], *, seed: int = 0
) -> tuple[Score, ...]:
    """Return AP and AOS with intervals, by class, kind of overlap and IoU threshold (`OVERLAPS`).

    detections (LiDAR frame) and truths run over the same frames; seed: of the bootstrap over scenes. Raises
    `InputError` where there are no frames.
    """
    if not truths:
        raise InputError("evaluation on 0 frames: at least one is wanted")
    scenes = tuple(truth.scene for truth in truths)
    scores = []
    for name in classes:
        found = [select_class(boxes, name) for boxes in detections]
        targets = [select_class(truth.targets, name) for truth in truths]
        neutral = [select_class(truth.neutral, name) for truth in truths]
        hidden = sum(len(select_class(truth.hidden, name)) for truth in truths)
        for kind, overlap in OVERLAPS:
            matches = match(found, targets, neutral, overlap, kind)
            low, high = bootstrap_interval(matches, scenes, rng=stream(seed, "bootstrap"))
            ap, aos, right = average_precision(matches), orientation_similarity(matches), right_headings(matches)
            numbers = map(round_or_none, (ap, low, high, aos, right))
            scores.append(Score(name, kind, overlap, *numbers, targets=sum(map(len, targets)), hidden=hidden))
    return tuple(scores)


def select_class(boxes: Boxes, name: str) -> Boxes:
    """Return the boxes with the label `name`."""
    return boxes[boxes.label == name]


def round_or_none(value: float) -> float | None:
    """Return the number rounded to six decimals, or None for NaN, which JSON cannot hold."""
    return None if np.isnan(value) else round(value, 6)
