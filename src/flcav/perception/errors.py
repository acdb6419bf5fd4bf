"""The error registry: where a detector was wrong, each mistake once, so that a sensor can be placed where it helps.

A mistake is an object with at least one LiDAR return that was missed, or a detection, with a return in it, of nothing:
both within the detector's range. A missed object is registered once per track; false positives of one scene within
`SAME_PLACE_M` of one another are one.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from flcav.files import atomic_path
from flcav.geometry import Boxes, inverse, points_in_boxes, transform_points
from flcav.perception.metrics.matching import assign_targets, on_neutral
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import detection_labels, only_lidar
from flcav.perception.objects.targets import in_range
from flcav.sensors.frame import Frame

SAME_PLACE_M = 2.0
OVERLAP = 0.5  # 3D IoU that counts as found

MISS, FALSE_POSITIVE = "miss", "false_positive"


@dataclass(frozen=True)
class DetectionError:
    """One registered mistake."""

    x: float  # geometric centre, world [m]
    y: float
    z: float
    weight: float  # what covering it is worth
    kind: str  # miss | false_positive
    label: str  # detection class
    returns: int  # LiDAR returns in it
    occlusion: float  # of a missed object, [0, 1]; NaN for a false positive
    scene: str
    track: str  # the object's; false positives are numbered per scene


def register_errors(
    frames: Sequence[Frame], detections: Sequence[Boxes], config: SecondConfig, threshold: float = 0.3
) -> list[DetectionError]:
    """Return the mistakes of `detections` (LiDAR frame, one `Boxes` per frame) that score at least `threshold`.

    A mistake is registered where and as it was first made; `frames` are gone through in the order they come.
    """
    errors: dict[tuple[str, str], DetectionError] = {}
    for frame, found in zip(frames, detections, strict=True):
        found = found[np.flatnonzero(found.score >= threshold)] if found.score is not None else found
        matched = np.zeros(len(found), dtype=bool)
        for error in _misses(frame, found, matched, config):
            errors.setdefault((error.scene, error.track), error)
        for error in _false_positives(frame, found[~matched], config):
            known = [e for e in errors.values() if e.kind == FALSE_POSITIVE and e.scene == error.scene]
            if not any(_distance(e, error) <= SAME_PLACE_M for e in known):
                track = f"{FALSE_POSITIVE}{len(known)}"
                errors[(error.scene, track)] = DetectionError(**{**asdict(error), "track": track})
    return list(errors.values())


def save_errors(errors: Sequence[DetectionError], path: Path) -> None:
    """Write the registry as Parquet, one column per field of `DetectionError`, atomically."""
    kinds = {float: pa.float64(), int: pa.int64(), str: pa.string()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in DetectionError.__annotations__.items()])
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_pylist([asdict(error) for error in errors], schema=schema), temporary)


def load_errors(path: Path) -> list[DetectionError]:
    """Return the registry that `save_errors` wrote."""
    return [DetectionError(**row) for row in pq.read_table(path).to_pylist()]


def _misses(frame: Frame, found: Boxes, matched: np.ndarray, config: SecondConfig) -> list[DetectionError]:
    """Return the objects not found, and mark in `matched` the detections that found something or lie on something."""
    truth = frame.annotations
    boxes = truth.boxes.transformed(inverse(frame.world_from_sensor(only_lidar(frame))))
    label = detection_labels(truth.boxes.label, config.classes)
    asked = (label != "") & (truth.returns >= 1) & in_range(boxes, config)
    missed = asked.copy()
    for name in config.classes:
        own, objects = np.flatnonzero(found.label == name), np.flatnonzero(asked & (label == name))
        target = assign_targets(found[own], boxes[objects], OVERLAP)
        matched[own[target >= 0]] = True
        missed[objects[target[target >= 0]]] = False
    matched |= on_neutral(found, boxes)
    return [
        DetectionError(
            *(float(value) for value in truth.boxes.center[i]),
            weight=1.0,
            kind=MISS,
            label=str(label[i]),
            returns=int(truth.returns[i]),
            occlusion=float(truth.occlusion[i]),
            scene=frame.scene,
            track=str(truth.track[i]),
        )
        for i in np.flatnonzero(missed)
    ]


def _false_positives(frame: Frame, found: Boxes, config: SecondConfig) -> list[DetectionError]:
    name = only_lidar(frame)
    found = found[in_range(found, config)]
    returns = points_in_boxes(frame.lidar[name], found).sum(1)
    world = transform_points(frame.world_from_sensor(name), found.center)
    return [
        DetectionError(
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


def _distance(a: DetectionError, b: DetectionError) -> float:
    return float(np.linalg.norm([a.x - b.x, a.y - b.y, a.z - b.z]))
