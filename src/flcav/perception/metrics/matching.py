"""Greedy matching of detections to ground truth by IoU, with neutral objects as in the KITTI benchmark."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes, wrap_angle
from flcav.perception.ops.rotated import Kind, intersection_area, iou


@dataclass(frozen=True)
class Matches:
    """True and false positives: the D detections of F frames that count, highest score first.

    Detections that lie on a neutral object are not among them.
    """

    score: NDArray[np.float64]  # (D,)
    hit: NDArray[np.bool_]  # (D,) True: true positive; False: false positive
    turned: NDArray[np.float64]  # (D,) heading error [rad], in [0, pi]; NaN for a false positive
    frame: NDArray[np.int64]  # (D,) number of the frame, 0 to F - 1
    targets: NDArray[np.int64]  # (F,) number of targets in each frame


def match(
    detections: Sequence[Boxes],
    targets: Sequence[Boxes],
    neutral: Sequence[Boxes],
    overlap: float,
    kind: Kind = "3d",
) -> Matches:
    """Return the true and false positives of one class over frames; the three sequences run over the same frames.

    In each frame, in order of score, a detection is matched to the unmatched target of highest IoU (of `kind`), if that
    is at least `overlap`. An unmatched detection is left out where it lies on a neutral object, see `on_neutral`;
    otherwise it is a false positive. This is the rule of the KITTI benchmark, with greedy assignment by score.

    Raises ValueError where there are detections without scores.
    """
    parts = [_match_frame(*one, overlap, kind) for one in zip(detections, targets, neutral, strict=True)]
    frame = np.repeat(np.arange(len(parts)), [len(scores) for scores, _ in parts])
    score, turned = (np.concatenate(column) for column in zip(*parts)) if parts else (np.zeros(0), np.zeros(0))
    order = np.argsort(-score, kind="stable")
    wanted = np.array([len(boxes) for boxes in targets], dtype=np.int64)
    return Matches(score[order], ~np.isnan(turned[order]), turned[order], frame[order], wanted)


def assign_targets(detections: Boxes, targets: Boxes, overlap: float, kind: Kind = "3d") -> NDArray[np.int64]:
    """Return (D,) the index of the target matched to each detection, -1 for none.

    Assignment is greedy by score, by IoU of `kind` from `overlap` on; each target is matched once at most. Raises
    ValueError where there are detections without scores.
    """
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

    The intersection is divided by the area of the detection. IoU would not do: a car detected on a bus covers a small
    part of the bus.
    """
    return np.any(lies_on(detections, neutral), axis=1)


def lies_on(detections: Boxes, objects: Boxes) -> NDArray[np.bool_]:
    """Return (D, N) whether at least half of a detection's footprint lies on each of N objects."""
    out = np.zeros((len(detections), len(objects)), dtype=bool)
    if not len(objects):
        return out
    radius = np.hypot(detections.size[:, :1], detections.size[:, 1:2]) + np.hypot(
        objects.size[:, 0], objects.size[:, 1]
    )
    distance = np.linalg.norm(detections.center[:, None, :2] - objects.center[None, :, :2], axis=2)
    of, on = np.nonzero(distance < radius / 2)
    rows, boxes = torch.from_numpy(detections.array()[of]), torch.from_numpy(objects.array()[on])
    shared = intersection_area(rows, boxes).numpy()
    out[of, on] = shared >= 0.5 * detections.size[of, 0] * detections.size[of, 1]
    return out


def _match_frame(
    detections: Boxes, targets: Boxes, neutral: Boxes, overlap: float, kind: Kind
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the scores (D,) of one frame's detections that count, and their heading errors (D,), see `Matches`."""
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
