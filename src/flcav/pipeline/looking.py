"""One sweep seen by two networks of objects, for the picture of before and after."""

from pathlib import Path

import numpy as np

from flcav.geometry import Boxes
from flcav.perception.metrics.matching import assign_targets, on_neutral
from flcav.perception.objects.detect import detect
from flcav.perception.objects.evaluate import Asked, asked_of
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import only_lidar
from flcav.pipeline.frames import Frames
from flcav.pipeline.results import Looked, Seen
from flcav.pipeline.stages import stage_network

SHOWN_SCORE = 0.3


def look(before: Path, after: Path, split: Frames) -> Looked:
    """Detect with the networks of two steps in the test frame that holds most targets, whatever they find there."""
    networks = {name: stage_network(OBJECTS, folder) for name, folder in (("before", before), ("after", after))}
    config = networks["before"].config
    truths = [asked_of(split.data.frame(i), config) for i in split.vehicles]
    best = int(np.argmax([len(truth.targets) for truth in truths]))
    frame, truth = split.data.frame(split.vehicles[best]), truths[best]
    points = frame.lidar[only_lidar(frame)]
    seen = {
        name: _matched(detect(network, points, score_threshold=SHOWN_SCORE), truth)
        for name, network in networks.items()
    }
    return Looked(split.vehicles[best], _rows(truth.targets), seen["before"], seen["after"])


def _matched(found: Boxes, truth: Asked) -> Seen:
    """Return the detections that count, which of them hit, and which targets were found."""
    target = assign_targets(found, truth.targets, 0.5)
    counts = (target >= 0) | ~on_neutral(found, truth.neutral)
    hits = target[counts]
    reached = np.isin(np.arange(len(truth.targets)), hits)
    return Seen(_rows(found[counts]), tuple((hits >= 0).tolist()), tuple(reached.tolist()))


def _rows(boxes: Boxes) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, boxes.array().tolist()))
