"""Average precision where it is hard and where it is easy: by distance, by occlusion, by weather."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate
from flcav.perception.metrics import average_precision, match
from flcav.perception.objects.evaluate import OVERLAPS, Asked, number_or_none, of_class
from flcav.world.weather import WEATHER_CLASSES

DISTANCES_M = ((0, 20), (20, 40), (40, 80))
OCCLUSIONS = ((0.0, 0.2), (0.2, 0.6), (0.6, 1.01))
BORDER_M = 2.0  # a detection this far beyond a range of distances may still be of an object in it


class Slice(NamedTuple):
    """Some of the objects, or some of the frames."""

    by: str  # distance | occlusion | weather
    name: str
    detections: list[Boxes]
    wanted: list[NDArray[np.bool_]]  # of each frame, (targets,): which of them are asked for; others are neutral
    frames: NDArray[np.int64]


def sliced(detections: Sequence[Boxes], truths: Sequence[Asked], classes: Sequence[str]) -> list[dict[str, Any]]:
    """Return a row per slice that holds targets of a class, kind of overlap and IoU: its AP and number of targets."""
    rows = []
    for part in slices(detections, truths):
        for label in classes:
            found = [of_class(boxes, label) for boxes in part.detections]
            own = [truth.targets.label == label for truth in truths]
            targets = [t.targets[o & w] for t, o, w in zip(truths, own, part.wanted, strict=True)]
            count = sum(len(targets[frame]) for frame in part.frames)
            if not count:
                continue
            others = [t.targets[o & ~w] for t, o, w in zip(truths, own, part.wanted, strict=True)]
            neutral = [concatenate([of_class(t.neutral, label), o]) for t, o in zip(truths, others, strict=True)]
            for kind, overlap in OVERLAPS:
                ap = average_precision(match(found, targets, neutral, overlap, kind), part.frames)
                row = {"by": part.by, "slice": part.name, "class": label, "kind": kind, "iou": overlap}
                rows.append(row | {"ap": number_or_none(ap), "targets": count})
    return rows


def slice_lines(rows: Sequence[Mapping[str, Any]], overlap: float) -> list[str]:
    """Return the rows of `sliced` in words, of one IoU: a line per class and slice, of one class after the other."""
    parts: dict[str, dict[tuple[str, str], dict[str, Any]]] = {}
    for row in rows:
        if row["iou"] == overlap:
            own = parts.setdefault(row["class"], {}).setdefault((row["by"], row["slice"]), {"targets": row["targets"]})
            own[row["kind"]] = row["ap"]
    return [
        f"{label:<12}{by:<11}{name.replace('_', ' '):<12}AP 3d {found['3d']:.3f}  bev {found['bev']:.3f}"
        f"  (objects: {found['targets']})"
        for label, own in parts.items()
        for (by, name), found in own.items()
    ]


def slices(detections: Sequence[Boxes], truths: Sequence[Asked]) -> Iterator[Slice]:
    """Yield the slices of frames; occlusions where they are known, weathers where there are several."""
    everything = np.arange(len(truths))
    for low, high in DISTANCES_M:
        near = [_between(_distance(boxes), low - BORDER_M, high + BORDER_M) for boxes in detections]
        found = [boxes[kept] for boxes, kept in zip(detections, near, strict=True)]
        wanted = [_between(_distance(truth.targets), low, high) for truth in truths]
        yield Slice("distance", f"{low}-{high} m", found, wanted, everything)
    hidden = [truth.occlusion for truth in truths if truth.occlusion is not None]
    if len(hidden) == len(truths):
        for low, high in OCCLUSIONS:
            wanted = [_between(share, low, high) for share in hidden]
            yield Slice("occlusion", f"{low:.0%}-{min(high, 1):.0%}", list(detections), wanted, everything)
    seen = {truth.weather for truth in truths}
    weathers = [name for name in WEATHER_CLASSES if name in seen]
    for name in weathers if len(weathers) > 1 else ():
        wanted = [np.ones(len(truth.targets), dtype=bool) for truth in truths]
        frames = np.flatnonzero([truth.weather == name for truth in truths])
        yield Slice("weather", name, list(detections), wanted, frames)


def _distance(boxes: Boxes) -> NDArray[np.float64]:
    return np.hypot(boxes.center[:, 0], boxes.center[:, 1])


def _between(value: NDArray[np.float64], low: float, high: float) -> NDArray[np.bool_]:
    return (value >= low) & (value < high)
