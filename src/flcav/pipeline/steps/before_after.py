"""Detections of two networks in one test sweep, matched with its targets: before and after the stages of a run."""

from pathlib import Path

import numpy as np

from flcav.geometry import Boxes
from flcav.perception.metrics.matching import assign_targets, on_neutral
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth, asked_of
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import load_stage_network
from flcav.pipeline.results.tests import SweepComparison, SweepDetections

SHOWN_SCORE = 0.3  # lowest score of a detection that is shown


def detect_before_after(before: Path, after: Path, split: Frames) -> SweepComparison:
    """Return the detections of two networks in the test frame with the most targets.

    `before`, `after`: folders of the steps that trained the networks. Detections score `SHOWN_SCORE` or more.
    """
    networks = {name: load_stage_network(OBJECTS, folder) for name, folder in (("before", before), ("after", after))}
    config = networks["before"].config
    truths = [asked_of(split.data.frame(i), config) for i in split.vehicles]
    best = int(np.argmax([len(truth.targets) for truth in truths]))
    frame, truth = split.data.frame(split.vehicles[best]), truths[best]
    seen = {
        name: _matched(detect_in(network, [frame], score_threshold=SHOWN_SCORE)[0], truth)
        for name, network in networks.items()
    }
    return SweepComparison(split.vehicles[best], _rows(truth.targets), seen["before"], seen["after"])


def _matched(found: Boxes, truth: FrameTruth) -> SweepDetections:
    """Match detections to targets at IoU 0.5; detections of neutral objects are left out."""
    target = assign_targets(found, truth.targets, 0.5)
    counts = (target >= 0) | ~on_neutral(found, truth.neutral)
    hits = target[counts]
    reached = np.isin(np.arange(len(truth.targets)), hits)
    return SweepDetections(_rows(found[counts]), tuple((hits >= 0).tolist()), tuple(reached.tolist()))


def _rows(boxes: Boxes) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, boxes.array().tolist()))
