"""Error registry of object detection: misses and false positives.

A miss is a target or faint object (see `flcav.perception.objects.truth`) without a detection. A false positive is a
detection on no annotated object with at least one LiDAR return in its box. Both lie within the range of the network.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from flcav.geometry import Boxes, points_in_boxes, transform_points
from flcav.perception.errors import FALSE_POSITIVE, MISS, THRESHOLD, PerceptionError
from flcav.perception.metrics.matching import assign_targets, on_neutral
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.truth import choose_lidar, ground_truth, in_range
from flcav.sensors.frame import Frame

OVERLAP = 0.5  # 3D IoU from which an object is detected


def find_errors(
    frames: Iterable[Frame], detections: Iterable[Boxes], config: SecondConfig, threshold: float = THRESHOLD
) -> Iterator[list[PerceptionError]]:
    """Yield the misses and false positives of each frame, of detections of score `threshold` or more.

    They are at world coordinates; those that repeat over frames are among them, see `flcav.perception.errors`.
    detections: one `Boxes` per frame, LiDAR frame. Raises ValueError where these and `frames` differ in length.
    """
    for frame, found in zip(frames, detections, strict=True):
        found = found[np.flatnonzero(found.score >= threshold)] if found.score is not None else found
        matched = np.zeros(len(found), dtype=bool)
        missed = _misses(frame, found, matched, config)
        yield [*missed, *_false_positives(frame, found[~matched], config)]


def _misses(frame: Frame, found: Boxes, matched: np.ndarray, config: SecondConfig) -> list[PerceptionError]:
    """Return the missed objects, and set `matched` (N,) for detections that match or lie on an annotated object."""
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
    name = choose_lidar(frame)
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
