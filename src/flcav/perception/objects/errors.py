"""What a detector of objects misses and invents.

A mistake is a target or a faint object (see `truth`) that was missed, or a detection, with a return in it, of nothing:
both within the detector's range.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from flcav.geometry import Boxes, points_in_boxes, transform_points
from flcav.perception.errors import FALSE_POSITIVE, MISS, THRESHOLD, PerceptionError, keep_first
from flcav.perception.metrics.matching import assign_targets, on_neutral
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.truth import ground_truth, in_range, only_lidar
from flcav.sensors.frame import Frame

OVERLAP = 0.5  # 3D IoU that counts as found


def register_errors(
    frames: Iterable[Frame], detections: Iterable[Boxes], config: SecondConfig, threshold: float = THRESHOLD
) -> tuple[PerceptionError, ...]:
    """Return the mistakes of `detections` (LiDAR frame, one `Boxes` per frame) that score at least `threshold`.

    A mistake is registered where and as it was first made; `frames` are gone through in the order they come.
    """
    return keep_first(_all_errors(frames, detections, config, threshold))


def _all_errors(
    frames: Iterable[Frame], detections: Iterable[Boxes], config: SecondConfig, threshold: float
) -> Iterator[PerceptionError]:
    for frame, found in zip(frames, detections, strict=True):
        found = found[np.flatnonzero(found.score >= threshold)] if found.score is not None else found
        matched = np.zeros(len(found), dtype=bool)
        yield from _misses(frame, found, matched, config)
        yield from _false_positives(frame, found[~matched], config)


def _misses(frame: Frame, found: Boxes, matched: np.ndarray, config: SecondConfig) -> list[PerceptionError]:
    """Return the objects not found, and mark in `matched` the detections that found something or lie on something."""
    truth, annotations = ground_truth(frame, config), frame.annotations
    label, asked = truth.boxes.label, truth.target | truth.faint
    missed = asked.copy()
    for name in config.classes:
        own, objects = np.flatnonzero(found.label == name), np.flatnonzero(asked & (label == name))
        target = assign_targets(found[own], truth.boxes[objects], OVERLAP)
        matched[own[target >= 0]] = True
        missed[objects[target[target >= 0]]] = False
    matched |= on_neutral(found, truth.boxes)
    return [
        PerceptionError(
            *(float(value) for value in annotations.boxes.center[i]),
            weight=1.0,
            kind=MISS,
            label=str(label[i]),
            returns=int(truth.returns[i]),
            occlusion=float(annotations.occlusion[i]),
            scene=frame.scene,
            track=str(annotations.track[i]),
        )
        for i in np.flatnonzero(missed)
    ]


def _false_positives(frame: Frame, found: Boxes, config: SecondConfig) -> list[PerceptionError]:
    name = only_lidar(frame)
    found = found[in_range(found, config)]
    returns = points_in_boxes(frame.lidar[name], found).sum(1)
    world = transform_points(frame.world_from_sensor(name), found.center)
    return [
        PerceptionError(
            *(float(value) for value in world[i]),
            weight=1.0,
            kind=FALSE_POSITIVE,
            label=str(found.label[i]),
            returns=int(returns[i]),
            occlusion=float("nan"),
            scene=frame.scene,
            track="",
        )
        for i in np.flatnonzero(returns >= 1)
    ]
