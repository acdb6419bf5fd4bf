"""Which detection found which object."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes, wrap_angle
from flcav.perception.ops.rotated import Kind, intersection_area, iou


@dataclass(frozen=True)
class Matches:
    """The D detections of F frames that count either way, best score first."""

    score: NDArray[np.float64]  # (D,)
    hit: NDArray[np.bool_]  # (D,) whether it found a target
    turned: NDArray[np.float64]  # (D,) angle between its heading and its target's [rad], in [0, pi]; NaN without target
    frame: NDArray[np.int64]  # (D,)
    targets: NDArray[np.int64]  # (F,) objects to find


def match(
    detections: Sequence[Boxes],
    targets: Sequence[Boxes],
    neutral: Sequence[Boxes],
    overlap: float,
    kind: Kind = "3d",
) -> Matches:
    """Return the matches of one class over frames; the three sequences run over the same frames.

    In each frame detections choose in order of score: the free target of highest IoU, if that is at least `overlap`.
    One without a target is left out where it lies on a neutral object, see `on_neutral`; otherwise it is a false
    positive. (The rule of the KITTI benchmark, with greedy assignment by score.)
    """
    parts = [_match_frame(*one, overlap, kind) for one in zip(detections, targets, neutral, strict=True)]
    frame = np.repeat(np.arange(len(parts)), [len(scores) for scores, _ in parts])
    score, turned = (np.concatenate(column) for column in zip(*parts)) if parts else (np.zeros(0), np.zeros(0))
    order = np.argsort(-score, kind="stable")
    wanted = np.array([len(boxes) for boxes in targets], dtype=np.int64)
    return Matches(score[order], ~np.isnan(turned[order]), turned[order], frame[order], wanted)


def assign_targets(detections: Boxes, targets: Boxes, overlap: float, kind: Kind = "3d") -> NDArray[np.int64]:
    """Return (D,) the target each detection found, -1 for none: greedy by score, each target once."""
    found = np.full(len(detections), -1)
    if not len(detections) or not len(targets):
        return found
    ious = iou(torch.from_numpy(detections.array()), torch.from_numpy(targets.array()), kind).numpy()
    for index in np.argsort(-_scores(detections), kind="stable"):
        best = int(ious[index].argmax())
        if ious[index, best] >= overlap:
            found[index] = best
            ious[:, best] = -1
    return found


def on_neutral(detections: Boxes, neutral: Boxes) -> NDArray[np.bool_]:
    """Return (D,) whether at least half of a detection's footprint lies on one neutral object.

    By the detection's own area, not by IoU: a car found on a bus covers a small part of the bus.
    """
    out = np.zeros(len(detections), dtype=bool)
    if not len(neutral):
        return out
    radius = np.hypot(detections.size[:, :1], detections.size[:, 1:2]) + np.hypot(
        neutral.size[:, 0], neutral.size[:, 1]
    )
    distance = np.linalg.norm(detections.center[:, None, :2] - neutral.center[None, :, :2], axis=2)
    of, on = np.nonzero(distance < radius / 2)
    rows, boxes = torch.from_numpy(detections.array()[of]), torch.from_numpy(neutral.array()[on])
    shared = intersection_area(rows, boxes).numpy()
    out[of[shared >= 0.5 * detections.size[of, 0] * detections.size[of, 1]]] = True
    return out


def _match_frame(
    detections: Boxes, targets: Boxes, neutral: Boxes, overlap: float, kind: Kind
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (D,) scores of the detections that count, and `Matches.turned` of each."""
    found = assign_targets(detections, targets, overlap, kind)
    hit = found >= 0
    turned = np.full(len(found), np.nan)
    turned[hit] = np.abs(wrap_angle(detections.yaw[hit] - targets.yaw[found[hit]]))
    counts = hit | ~on_neutral(detections, neutral)
    return _scores(detections)[counts], turned[counts]


def _scores(detections: Boxes) -> NDArray[np.float64]:
    if detections.score is None:
        if len(detections):
            raise ValueError("detections without scores cannot be matched")
        return np.zeros(0)
    return detections.score
