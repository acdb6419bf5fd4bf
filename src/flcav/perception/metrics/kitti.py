"""Average precision as KITTI's object benchmark counts it: easy, moderate and hard, AP|R40 of images, ground and space.

Geiger, Lenz, Urtasun, "Are we ready for Autonomous Driving?", CVPR 2012, and `evaluate_object.cpp` of the benchmark's
development kit; 40 recall positions by Simonelli et al., "Disentangling Monocular 3D Object Detection", ICCV 2019.

An object counts at a level by the height of its rectangle in the image, its occlusion and truncation; one that does not
is ignored, and so are objects of the similar class. Detections lower than the level's height are ignored. In the image,
detections in a DontCare region are ignored, too; such a region has no place in space.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Ints, Mask, Words
from flcav.machine.compiled import compiled

COUNTS, IGNORED, OTHER = 0, 1, -1  # state of an object or a detection for a class at a level
RECALLS = 41  # positions of recall, of which the first, 0, is left out of the mean
SIMILAR = {"Car": "Van", "Pedestrian": "Person_sitting"}


class Difficulty(NamedTuple):
    """Criteria of a level of difficulty: the objects that count at it."""

    height_px: float  # of the rectangle in the image: higher ones count
    occlusion: int  # at most: 0 fully visible, 1 partly and 2 largely occluded
    truncation: float  # at most


LEVELS: Mapping[str, Difficulty] = {
    "easy": Difficulty(40, 0, 0.15),
    "moderate": Difficulty(25, 1, 0.3),
    "hard": Difficulty(25, 2, 0.5),
}


@dataclass(frozen=True)
class ClassFrame:
    """The detections and objects of one frame for a class, a level and a kind of overlap."""

    score: Array  # (D,)
    detection: Ints  # (D,) COUNTS, IGNORED or OTHER
    label: Ints  # (G,) of objects, the same
    overlap: Array  # (D, G) IoU
    excused: Mask  # (D,) lies in a DontCare region


def label_states(
    name: str, labels: Words, height_px: Array, occlusion: Ints, truncation: Array, level: Difficulty
) -> Ints:
    """Return (G,) whether each of a frame's objects counts for the class `name` at a level."""
    hard = (occlusion > level.occlusion) | (truncation > level.truncation) | (height_px <= level.height_px)
    own, similar = labels == name, labels == SIMILAR.get(name, "")
    return np.where(own & ~hard, COUNTS, np.where(own | similar, IGNORED, OTHER)).astype(np.int64)


def detection_states(name: str, labels: Words, height_px: Array, level: Difficulty) -> Ints:
    """Return (D,) whether each of a frame's detections counts for the class `name` at a level."""
    return np.where(height_px < level.height_px, IGNORED, np.where(labels == name, COUNTS, OTHER)).astype(np.int64)


def average_precision_r40(frames: Sequence[ClassFrame], limit: float) -> float | None:
    """Return the AP|R40 in [0, 1] of frames of one class, level and kind; None where no object counts.

    limit: IoU above which a detection is of an object. At each of the scores that reach a further fortieth of recall,
    detections and objects are matched anew; precision is made to fall with recall, and its mean is taken.
    """
    targets = sum(int((frame.label == COUNTS).sum()) for frame in frames)
    if not targets:
        return None
    busy = [frame for frame in frames if len(frame.score)]
    reached = [_match(*_arguments(frame), limit, -np.inf, False)[2] for frame in busy]
    scores = np.concatenate(reached) if reached else np.zeros(0)
    precision = np.zeros(RECALLS)
    for place, threshold in enumerate(find_thresholds(scores, targets)):
        counts = [count_matches(frame, limit, threshold) for frame in busy]
        true, false = (sum(column) for column in zip(*counts, strict=True))
        precision[place] = true / max(true + false, 1)
    falling = np.maximum.accumulate(precision[::-1])[::-1]
    return float(falling[1:].mean())


def count_matches(frame: ClassFrame, limit: float, threshold: float) -> tuple[int, int]:
    """Return the numbers of true and of false positives of a frame, among detections of `threshold` or more."""
    return _match(*_arguments(frame), limit, threshold, True)[:2]


def find_thresholds(scores: Array, targets: int) -> list[float]:
    """Return the scores, from the highest on, at which recall comes nearest to each next fortieth, RECALLS at most.

    scores: of the detections that match one of `targets` objects.
    """
    ordered = np.sort(scores)[::-1].tolist()
    found: list[float] = []
    recall = 0.0
    for rank, score in enumerate(ordered, start=1):
        here, last = rank / targets, rank == len(ordered)
        further = here if last else (rank + 1) / targets
        if further - recall < recall - here and not last:
            continue
        found.append(score)
        recall += 1 / (RECALLS - 1)
    return found[:RECALLS]


def _arguments(frame: ClassFrame) -> tuple[Array, Ints, Ints, Array, Mask]:
    return frame.score, frame.detection, frame.label, frame.overlap, frame.excused


@compiled
def _match(
    score: Array,
    detection: Ints,
    label: Ints,
    overlap: Array,
    excused: Mask,
    limit: float,
    threshold: float,
    counted: bool,
) -> tuple[int, int, Array]:
    """Return true positives, false positives, and the scores (T,) of the true ones, among scores from `threshold` on.

    Objects take detections in their order: with `counted` that of highest overlap, one that counts before an ignored
    one; without, which is how thresholds are found, that of highest score.
    """
    taken = np.zeros(len(score), np.bool_)
    true = 0
    reached = np.zeros(len(label))
    for g in range(len(label)):
        if label[g] == OTHER:
            continue
        best, most, spare = -1, 0.0, False
        for d in range(len(score)):
            if detection[d] == OTHER or taken[d] or score[d] < threshold or overlap[d, g] <= limit:
                continue
            if not counted:
                if best < 0 or score[d] > score[best]:
                    best = d
            elif detection[d] == COUNTS and (best < 0 or spare or overlap[d, g] > most):
                best, most, spare = d, overlap[d, g], False
            elif detection[d] == IGNORED and best < 0:
                best, spare = d, True
        if best < 0:
            continue
        taken[best] = True
        if label[g] == COUNTS and detection[best] == COUNTS:
            reached[true] = score[best]
            true += 1
    false = 0
    for d in range(len(score)):
        if detection[d] == COUNTS and not taken[d] and score[d] >= threshold and not excused[d]:
            false += 1
    return true, false, reached[:true]
