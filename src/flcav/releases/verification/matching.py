"""Matching of one class's detections slice by slice, from overlaps that are computed once per frame.

The rule is that of `flcav.perception.metrics.match`, where targets outside of a slice are neutral.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes, wrap_angle
from flcav.perception.metrics import Matches
from flcav.perception.metrics.detection import lies_on, match_greedily, on_neutral
from flcav.perception.objects.truth import FrameTruth, select_class
from flcav.perception.ops.boxes import iou

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Overlaps:
    """How the D detections of one class in a frame lie on its T targets and on neutral objects."""

    score: NDArray[np.float64]  # (D,) falling
    iou: NDArray[np.float64]  # (D, T) of volumes
    turned: NDArray[np.float64]  # (D, T) difference of headings [rad], in [0, pi]
    covered: Mask  # (D, T) whether at least half of the detection's footprint lies on the target
    neutral: Mask  # (D,) the same on a neutral object
    detections: NDArray[np.int64]  # (D,) their places among the frame's detections of all classes
    targets: NDArray[np.int64]  # (T,) places of the targets among the frame's of all classes


def measure_overlaps(detections: Boxes, truth: FrameTruth, label: str) -> Overlaps:
    """Return the overlaps of the detections of one class in a frame."""
    own, among = np.flatnonzero(detections.label == label), np.flatnonzero(truth.targets.label == label)
    if detections.score is not None:
        own = own[np.argsort(-detections.score[own], kind="stable")]
    found, targets = detections[own], truth.targets[among]
    known = iou(torch.from_numpy(found.array()), torch.from_numpy(targets.array())).numpy()
    return Overlaps(
        score=np.zeros(0) if found.score is None else found.score,
        iou=known,
        turned=np.abs(wrap_angle(found.yaw[:, None] - targets.yaw)),
        covered=lies_on(found, targets),
        neutral=on_neutral(found, select_class(truth.neutral, label)),
        detections=own,
        targets=among,
    )


def match_overlaps(
    overlaps: Sequence[Overlaps], least: float, wanted: Sequence[Mask] | None = None, kept: Sequence[Mask] | None = None
) -> Matches:
    """Return the matches from an IoU of `least` on, of all targets or of a slice.

    wanted: of each frame, whether a target is in the slice. kept: of each frame, whether a detection counts in it.
    """
    parts = [
        _match_frame(each, least, None if wanted is None else wanted[number], None if kept is None else kept[number])
        for number, each in enumerate(overlaps)
    ]
    frame = np.repeat(np.arange(len(parts)), [len(scores) for scores, _, _ in parts])
    score = np.concatenate([scores for scores, _, _ in parts]) if parts else np.zeros(0)
    turned = np.concatenate([turned for _, turned, _ in parts]) if parts else np.zeros(0)
    order = np.argsort(-score, kind="stable")
    targets = np.array([count for _, _, count in parts], dtype=np.int64)
    return Matches(score[order], ~np.isnan(turned[order]), turned[order], frame[order], targets)


def assign_detections(each: Overlaps, least: float, inside: Mask, rows: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return (R,) the target of each of the detections `rows`, -1 for none, greedily by score.

    least: IoU from which a detection finds a target. inside (T,): targets that can be found. rows (R,), rising.
    """
    return match_greedily(np.where(inside, each.iou, -1.0)[rows], least)


def _match_frame(
    each: Overlaps, least: float, wanted: Mask | None, kept: Mask | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return the scores of one frame's detections that count, their heading errors (NaN: false), and its targets."""
    inside = np.ones(len(each.targets), bool) if wanted is None else wanted[each.targets]
    rows = np.arange(len(each.score)) if kept is None else np.flatnonzero(kept[each.detections])
    found = assign_detections(each, least, inside, rows)
    hit = found >= 0
    turned = np.full(len(rows), np.nan)
    turned[hit] = each.turned[rows[hit], found[hit]]
    ignored = each.neutral | each.covered[:, ~inside].any(axis=1)
    counts = hit | ~ignored[rows]
    return each.score[rows][counts], turned[counts], int(inside.sum())
