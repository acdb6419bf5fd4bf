"""Precision, recall and boxes of labels against ground truth."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, inverse
from flcav.perception.metrics import match
from flcav.perception.metrics.matching import assign_targets
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import asked_of, in_range, network_from_lidar
from flcav.pipeline.frames import Frames
from flcav.pipeline.results.training import LabelHistory, LabelQuality

TIGHT = 0.7  # IoU in 3D of a box that is as good as an annotated one
LABELS = "labels.json"  # quality of the labels before each round, in the folder of a stage


def read_history(folder: Path) -> LabelHistory:
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

    They are compared with ground truth, which nobody learns from here.
    """
    each = {name: iter(own) for name, own in samples.items()}
    found, targets, neutral = [], [], []
    for i in frames:
        frame, sample = split.data.frame(i), next(each[f"{region}/{split.data.keys[i].agent}"])
        truth, move = asked_of(frame, config), network_from_lidar(frame, config)
        boxes = sample.boxes[in_range(sample.boxes, config)]
        boxes = boxes if move is None else boxes.transform(inverse(move))
        found.append(Boxes.from_array(boxes.array(), boxes.label, np.ones(len(boxes))))
        targets.append(truth.targets)
        neutral.append(truth.neutral)
    matches, tight = (match(found, targets, neutral, overlap) for overlap in (0.5, TIGHT))
    right, there, count = int(matches.hit.sum()), int(matches.targets.sum()), len(matches.hit)
    quality = LabelQuality(round_, count, there, right / count if count else None, right / there if there else None)
    if not right:
        return quality
    pairs = [_pair(*frame) for frame in zip(found, targets, strict=True)]
    labels, objects = (np.concatenate(side) for side in zip(*pairs, strict=True))
    offset = np.linalg.norm(labels[:, :3] - objects[:, :3], axis=1)
    size = np.abs(labels[:, 3:6] - objects[:, 3:6]).max(axis=1)
    return replace(
        quality, tight=int(tight.hit.sum()) / right, offset_m=float(np.median(offset)), size_m=float(np.median(size))
    )


def _pair(found: Boxes, targets: Boxes) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the boxes (N, 7) of a frame's right labels, and those of their objects."""
    target = assign_targets(found, targets, 0.5)
    return found.array()[target >= 0], targets.array()[target[target >= 0]]
