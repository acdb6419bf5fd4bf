"""A sweep before and after training in three dimensions, as the script `scene.js` draws it in any page."""

import base64
from collections.abc import Sequence

import numpy as np

from flcav.arrays import Array
from flcav.config import Json
from flcav.runs.results.tests import WORDS, SweepComparison, SweepDetections
from flcav.sensors.frame import Frame

MOST_POINTS = 60_000  # of a sweep
FARTHEST_M = 320.0  # coordinate of a point that is sent: int16 centimetres


def describe_sweep(
    frame: Frame, compared: SweepComparison, stage: str = "", mark: Array | None = None, most: int = MOST_POINTS
) -> dict[str, Json]:
    """Return a sweep and its matched boxes as `scene.js` takes them: points as base64 of int16 [cm].

    `stage`: name of the one after which the later detections are; `mark` (3,): a place in the world [m] that is marked.
    Of more than `most` points every second, third and so on is left out.
    """
    lidar = next(iter(frame.lidar))
    points = frame.lidar[lidar][:, :3]
    points = points[np.isfinite(points).all(axis=1) & (np.abs(points) < FARTHEST_M).all(axis=1)]
    centimetres = np.round(points[:: max(-(-len(points) // most), 1)] * 100).astype("<i2")
    sweep: dict[str, Json] = {
        "points": base64.b64encode(centimetres.tobytes()).decode(),
        "ground": -float(frame.agent_from_sensor[lidar][2, 3]),
        "targets": _boxes(compared.targets),
        "before": _side("pretrained", compared.before),
        "after": _side(f"after {WORDS.get(stage, 'training')}", compared.after),
    }
    if mark is not None:
        lidar_from_world = np.linalg.inv(frame.world_from_sensor(lidar))
        sweep["mark"] = (lidar_from_world[:3, :3] @ mark + lidar_from_world[:3, 3]).round(2).tolist()
    return sweep


def _side(title: str, seen: SweepDetections) -> dict[str, Json]:
    return {"title": title, "boxes": _boxes(seen.boxes), "hit": list(seen.hit), "found": list(seen.found)}


def _boxes(rows: Sequence[Sequence[float]]) -> list[Json]:
    return [[round(value, 2) for value in row[:7]] for row in rows]
