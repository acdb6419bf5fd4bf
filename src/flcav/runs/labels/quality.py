"""Precision, recall and boxes of labels against ground truth."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, inverse
from flcav.perception.metrics import match
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.objects.model import SecondConfig
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import asked_of, in_range, network_from_lidar
from flcav.runs.frames import Frames
from flcav.runs.results.training import FoundTargets, LabelHistory, LabelQuality

RETURNS = 5, 20, 100  # of targets, from which their recall is counted apart
TIGHT = 0.7  # IoU in 3D of a box that is as good as an annotated one
LABELS = "labels.json"  # quality of the labels before each round, in the folder of a stage


def read_label_history(folder: Path) -> LabelHistory:
    """Return the quality of the labels of the rounds so far in a stage's folder."""
    return LabelHistory.load(folder, LABELS) if (folder / LABELS).exists() else LabelHistory()


def measure_labels(
    round_: int,
    split: Frames,
    frames: Sequence[int],
    region: str,
    samples: Mapping[str, Sequence[Sample]],
    config: SecondConfig,
) -> LabelQuality:
    """Return precision, recall and box errors of the labels of vehicles' `frames`, whose samples are in their order.

    Ground truth serves this measurement alone; no network is trained on it here.
    """
    each = {name: iter(own) for name, own in samples.items()}
    found, targets, neutral, returns = [], [], [], []
    for i in frames:
        frame, sample = split.data.frame(i), next(each[f"{region}/{split.data.keys[i].agent}"])
        truth, move = asked_of(frame, config), network_from_lidar(frame, config)
        boxes = sample.boxes[in_range(sample.boxes, config)]
        boxes = boxes if move is None else boxes.transform(inverse(move))
        found.append(Boxes.from_array(boxes.array(), boxes.label, np.ones(len(boxes))))
        targets.append(truth.targets)
        neutral.append(truth.neutral)
        returns += [] if truth.returns is None else [truth.returns]
    matches, tight = (match(found, targets, neutral, overlap) for overlap in (0.5, TIGHT))
    right, there, count = int(matches.hit.sum()), int(matches.targets.sum()), len(matches.hit)
    quality = LabelQuality(round_, count, there, right / count if count else None, right / there if there else None)
    if not right:
        return quality
    paired = [assign_targets(own, truth, 0.5) for own, truth in zip(found, targets, strict=True)]
    labels = np.concatenate([own.array()[target >= 0] for own, target in zip(found, paired, strict=True)])
    objects = np.concatenate([own.array()[target[target >= 0]] for own, target in zip(targets, paired, strict=True)])
    met = np.concatenate([np.isin(np.arange(len(own)), target) for own, target in zip(targets, paired, strict=True)])
    offset = np.linalg.norm(labels[:, :3] - objects[:, :3], axis=1)
    size = np.abs(labels[:, 3:6] - objects[:, 3:6]).max(axis=1)
    return replace(
        quality,
        tight=int(tight.hit.sum()) / right,
        offset_m=float(np.median(offset)),
        size_m=float(np.median(size)),
        by_returns=_count_by_returns(np.concatenate(returns), met) if len(returns) == len(targets) else None,
    )


def _count_by_returns(returns: NDArray[np.int64], met: NDArray[np.bool_]) -> tuple[FoundTargets, ...]:
    """Return the numbers of targets and of found (`met`) targets by LiDAR returns; both arrays are (T,)."""
    kind = np.searchsorted(RETURNS, returns, side="right") - 1
    kinds = range(len(RETURNS))
    return tuple(FoundTargets(RETURNS[k], int((kind == k).sum()), int(met[kind == k].sum())) for k in kinds)
