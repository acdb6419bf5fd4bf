"""Precision and recall of labels against ground truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from flcav.geometry import Boxes, inverse
from flcav.perception.metrics import match
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import asked_of, in_range, network_from_lidar
from flcav.pipeline.frames import Frames
from flcav.pipeline.results.training import LabelHistory, LabelQuality

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
    """Return precision and recall of the labels of vehicles' `frames`, whose samples are in the order of the frames.

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
    matches = match(found, targets, neutral, 0.5)
    right, there = int(matches.hit.sum()), int(matches.targets.sum())
    count = len(matches.hit)
    return LabelQuality(round_, count, there, right / count if count else None, right / there if there else None)
