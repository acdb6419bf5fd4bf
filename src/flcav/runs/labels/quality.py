"""Precision, recall and boxes of labels against ground truth."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, inverse
from flcav.perception.metrics.detection import assign_targets, match_at_each
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import asked_of, in_range, network_from_lidar
from flcav.runs.frames import Frames
from flcav.runs.results.training import ClassLabels, FoundTargets, LabelHistory, LabelQuality

RETURNS = 5, 20, 100  # lower ends of the classes of targets by LiDAR returns, for which recall is stated separately
TIGHT = 0.7  # IoU in 3D from which on a box is as good as an annotated one
LABELS = "labels.json"  # quality of the labels by round, in the folder of a stage


def read_label_history(folder: Path) -> LabelHistory:
    """Read the quality of the labels of the rounds so far from a stage's folder."""
    return LabelHistory.load(folder, LABELS) if (folder / LABELS).exists() else LabelHistory()


def measure_labels(
    round_: int,
    split: Frames,
    frames: Sequence[int],
    region: str,
    samples: Mapping[str, Sequence[Sample]],
    config: SecondConfig,
) -> LabelQuality:
    """Return precision, recall and box errors of the labels of vehicles' `frames`, before the round `round_`.

    `samples`: by "region/vehicle", in the order of the frames. Ground truth serves this measurement alone; no network
    is trained on it here.
    """
    left = {name: iter(labelled) for name, labelled in samples.items()}
    found, targets, neutral, returns = [], [], [], []
    for i in frames:
        frame = split.data.frame(i)
        sample = next(left[f"{region}/{split.data.keys[i].agent}"])
        truth = asked_of(frame, config)
        move = network_from_lidar(frame, config)  # a sample is in the network's frame, ground truth in the LiDAR's
        boxes = sample.boxes[in_range(sample.boxes, config)]
        boxes = boxes if move is None else boxes.transform(inverse(move))
        found.append(Boxes.from_array(boxes.array(), boxes.label, np.ones(len(boxes))))
        targets.append(truth.targets)
        neutral.append(truth.neutral)
        returns += [] if truth.returns is None else [truth.returns]
    counts = [_count_class(name, found, targets, neutral) for name in config.classes]
    by_class = tuple(each for each, _ in counts)
    right, there, count = (
        sum(column) for column in zip(*((e.right, e.targets, e.labels) for e in by_class), strict=True)
    )
    quality = LabelQuality(
        *(round_, count, there, right / count if count else None, right / there if there else None),
        by_class=by_class if len(by_class) > 1 else None,
    )
    if not right:
        return quality
    paired = [assign_targets(frame_boxes, truth, 0.5) for frame_boxes, truth in zip(found, targets, strict=True)]
    labels = np.concatenate(
        [frame_boxes.array()[target >= 0] for frame_boxes, target in zip(found, paired, strict=True)]
    )
    objects = np.concatenate(
        [frame_boxes.array()[target[target >= 0]] for frame_boxes, target in zip(targets, paired, strict=True)]
    )
    met = np.concatenate(
        [np.isin(np.arange(len(frame_boxes)), target) for frame_boxes, target in zip(targets, paired, strict=True)]
    )
    offset = np.linalg.norm(labels[:, :3] - objects[:, :3], axis=1)
    size = np.abs(labels[:, 3:6] - objects[:, 3:6]).max(axis=1)
    return replace(
        quality,
        tight=sum(tight for _, tight in counts) / right,
        offset_m=float(np.median(offset)),
        size_m=float(np.median(size)),
        by_returns=_count_by_returns(np.concatenate(returns), met) if len(returns) == len(targets) else None,
    )


def _count_class(
    name: str, found: Sequence[Boxes], targets: Sequence[Boxes], neutral: Sequence[Boxes]
) -> tuple[ClassLabels, int]:
    """Count the labels of a class, those that match a target of it and its targets; and the matches at `TIGHT`."""
    mine, asked = ([boxes[boxes.label == name] for boxes in sides] for sides in (found, targets))
    matches, tight = match_at_each(mine, asked, neutral, [("3d", 0.5), ("3d", TIGHT)])
    return ClassLabels(name, len(matches.hit), int(matches.hit.sum()), int(matches.targets.sum())), int(tight.hit.sum())


def _count_by_returns(returns: NDArray[np.int64], met: NDArray[np.bool_]) -> tuple[FoundTargets, ...]:
    """Count targets and found (`met`) targets by their LiDAR returns; both arrays are (T,)."""
    kind = np.searchsorted(RETURNS, returns, side="right") - 1
    kinds = range(len(RETURNS))
    return tuple(
        FoundTargets(RETURNS[number], int((kind == number).sum()), int(met[kind == number].sum())) for number in kinds
    )
