"""Velocities of detected objects: their errors, by a radar's echoes, and late fusion.

The velocity of a box is its speed along its heading. Where there are echoes in a box, their median range rate is the
part of it along the line of sight. Late fusion leaves the network that reads the LiDAR alone as it is: a box gets such
a speed, and a score that is calibrated separately for boxes with and without echoes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

from flcav.arrays import Array, Array32, Mask
from flcav.geometry import Boxes, heading_vectors, points_in_boxes
from flcav.perception.errors import THRESHOLD
from flcav.perception.metrics import fit_logistic
from flcav.perception.metrics.detection import assign_targets, on_neutral
from flcav.perception.objects.config import ECHO
from flcav.perception.objects.truth import FrameTruth, select_class
from flcav.storage.records import Class

OVERLAP = 0.5  # bird's-eye IoU from which a detection is of an object
MOVING_M_S = 1.0  # speed from which an object moves
MARGIN_M = 0.5  # around a box, in which echoes are the object's
ALONG = 0.3  # least cosine between heading and line of sight at which a range rate tells the speed


@dataclass(frozen=True)
class VelocityError:
    """Errors of the velocities of found objects of a class: lengths of the difference of vectors over ground."""

    label: Class
    median_m_s: float | None  # of the moving objects among them [m/s]; None without any
    high_m_s: float | None  # 90 % of those errors are at most this [m/s]
    moving: int  # found objects that move
    standing_m_s: float | None  # median error of those that stand [m/s]; None without any
    standing: int


def list_velocity_errors(found: Boxes, targets: Boxes, threshold: float = THRESHOLD) -> tuple[Array, Array]:
    """Return the errors (K,) [m/s] and the true speeds (K,) [m/s] of targets that detections of one class match.

    Both boxes have speeds. Detections score `threshold` or more; a reversed heading reverses a velocity.
    """
    if found.speed is None or targets.speed is None or found.score is None:
        return np.zeros(0), np.zeros(0)
    sure = np.flatnonzero(found.score >= threshold)
    target = assign_targets(found[sure], targets, OVERLAP, "bev")
    one, other = sure[target >= 0], target[target >= 0]
    velocity = found.speed[one, None] * heading_vectors(found.yaw[one])
    truth = targets.speed[other]
    errors = np.linalg.norm(velocity - truth[:, None] * heading_vectors(targets.yaw[other]), axis=1)
    return errors[np.isfinite(truth)], truth[np.isfinite(truth)]


def measure_velocities(
    found: Sequence[Boxes], truths: Sequence[FrameTruth], classes: Sequence[str]
) -> tuple[VelocityError, ...]:
    """Return the errors of velocities by class; nothing where the detections have no speeds."""
    rows = []
    for name in classes if any(boxes.speed is not None for boxes in found) else ():
        pairs = [
            list_velocity_errors(select_class(boxes, name), select_class(truth.targets, name))
            for boxes, truth in zip(found, truths, strict=True)
        ]
        errors, speeds = (np.concatenate(column) for column in zip(*pairs, strict=True))
        moving = np.abs(speeds) >= MOVING_M_S
        of_moving, of_standing = errors[moving], errors[~moving]
        rows.append(
            VelocityError(
                name,
                round(float(np.median(of_moving)), 3) if len(of_moving) else None,
                round(float(np.quantile(of_moving, 0.9)), 3) if len(of_moving) else None,
                len(of_moving),
                round(float(np.median(of_standing)), 3) if len(of_standing) else None,
                len(of_standing),
            )
        )
    return tuple(rows)


class LateFusion(NamedTuple):
    """Calibrations of scores, each a factor and a summand of logits: of boxes with echoes, and of those without."""

    seen: tuple[float, float]
    unseen: tuple[float, float]


def fit_late_fusion(
    found: Sequence[Boxes], clouds: Sequence[Array32], truths: Sequence[FrameTruth], name: str
) -> LateFusion:
    """Return the calibrations of a class, fitted on frames with detections (LiDAR frame) and clouds with echoes."""
    scores, hits, seen = [], [], []
    for boxes, cloud, truth in zip(found, clouds, truths, strict=True):
        of_class = select_class(boxes, name)
        counted = of_class[~on_neutral(of_class, select_class(truth.neutral, name))]
        assert counted.score is not None
        scores.append(counted.score)
        hits.append(assign_targets(counted, select_class(truth.targets, name), OVERLAP) >= 0)
        seen.append(find_echoes(counted, cloud).any(1))
    score, hit, with_echo = (np.concatenate(column) for column in (scores, hits, seen))
    return LateFusion(*(fit_logistic(score[part], hit[part]) for part in (with_echo, ~with_echo)))


def fuse_late(boxes: Boxes, cloud: Array32, fusion: LateFusion) -> Boxes:
    """Return the detections (LiDAR frame) with scores by `fusion` and speeds by the echoes in a cloud (N, 6).

    Boxes without an echo, or across the line of sight, keep their speed.
    """
    seen = find_echoes(boxes, cloud).any(axis=1)
    factor, summand = np.where(np.expand_dims(seen, 1), fusion.seen, fusion.unseen).T
    assert boxes.score is not None
    score = expit(factor * logit(np.clip(boxes.score, 1e-7, 1 - 1e-7)) + summand)
    return replace(take_speeds(boxes, cloud), score=score)


def take_speeds(boxes: Boxes, cloud: Array32) -> Boxes:
    """Return the boxes (LiDAR frame) with the speeds whose part along the line of sight is the echoes' range rate.

    It is the median of the echoes in a box, of a cloud (N, 6). Boxes without an echo, or across the line of sight, keep
    their speed.
    """
    inside = find_echoes(boxes, cloud)
    ahead = boxes.center[:, :2] / np.linalg.norm(boxes.center[:, :2], axis=1, keepdims=True)
    along = (ahead * heading_vectors(boxes.yaw)).sum(1)
    speed = np.full(len(boxes), np.nan) if boxes.speed is None else boxes.speed.copy()
    for row in np.flatnonzero(inside.any(axis=1) & (np.abs(along) >= ALONG)):
        speed[row] = np.median(cloud[inside[row], 4]) / along[row]
    return replace(boxes, speed=speed)


def find_echoes(boxes: Boxes, cloud: Array32) -> Mask:
    """Return whether each row of a cloud (N, 6) is an echo in each box: (B, N)."""
    return points_in_boxes(cloud, boxes, margin_m=MARGIN_M) & (cloud[:, 3] == ECHO)
