"""A step that looks at one sweep with two networks, for the before-and-after picture."""

from typing import Any

import numpy as np

from flcav.experiments.pretraining import WEIGHTS
from flcav.experiments.recording import opened
from flcav.experiments.steps import Work
from flcav.geometry import Boxes
from flcav.perception.metrics.matching import assign_targets, on_neutral
from flcav.perception.objects.detect import detect
from flcav.perception.objects.evaluate import Asked, asked_of
from flcav.perception.objects.truth import only_lidar
from flcav.perception.objects.weights import load_network

SHOWN_SCORE = 0.3


def look(work: Work, town: str, arms: dict[str, str]) -> dict[str, Any]:
    """Detect with each of `arms` (name -> step) in the test frame that holds most targets, whatever they find there."""
    data = opened(work, f"{town}-test")
    networks = {name: load_network(work.inputs[step] / WEIGHTS) for name, step in arms.items()}
    config = next(iter(networks.values())).config
    truths = [asked_of(data.frame(i), config) for i in range(len(data))]
    best = int(np.argmax([len(truth.targets) for truth in truths]))
    frame, truth = data.frame(best), truths[best]
    points = frame.lidar[only_lidar(frame)]
    seen = [
        {"name": name, **_matched(detect(network, points, score_threshold=SHOWN_SCORE), truth)}
        for name, network in networks.items()
    ]
    return {"frame": best, "key": frame.key, "targets": truth.targets.array().tolist(), "seen": seen}


def _matched(found: Boxes, truth: Asked) -> dict[str, Any]:
    """Return the detections that count, which of them hit, and which targets were found."""
    target = assign_targets(found, truth.targets, 0.5)
    counts = (target >= 0) | ~on_neutral(found, truth.neutral)
    hits = target[counts]
    return {
        "boxes": found[counts].array().tolist(),
        "hit": (hits >= 0).tolist(),
        "found": np.isin(np.arange(len(truth.targets)), hits).tolist(),
    }
