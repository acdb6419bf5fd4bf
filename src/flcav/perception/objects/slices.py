"""Average precision where it is hard and where it is easy: by distance, by occlusion, by weather."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate
from flcav.perception.metrics import average_precision, match
from flcav.perception.objects.evaluate import OVERLAPS, Asked, number_or_none, of_class
from flcav.perception.ops.rotated import Kind
from flcav.records import Class
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


@dataclass(frozen=True)
class SlicePrecision:
    """Average precision of one class in a slice, under one measure of overlap."""

    by: str  # distance | occlusion | weather
    slice: str
    label: Class
    kind: Kind
    iou: float
    ap: float | None
    targets: int


def sliced(detections: Sequence[Boxes], truths: Sequence[Asked], classes: Sequence[str]) -> tuple[SlicePrecision, ...]:
    """Return AP and number of targets of each slice that holds targets of a class, by kind of overlap and IoU."""
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
                rows.append(SlicePrecision(part.by, part.name, label, kind, overlap, number_or_none(ap), count))
    return tuple(rows)


def slice_lines(rows: Sequence[SlicePrecision], overlap: float) -> list[str]:
    """Return the rows of `sliced` in words, of one IoU: a line per class and slice, of one class after the other."""
    own = [row for row in rows if row.iou == overlap]
    ap = {(row.label, row.by, row.slice, row.kind): row.ap for row in own}
    known = {(row.label, row.by, row.slice): row.targets for row in own}
    labels = list(dict.fromkeys(row.label for row in own))
    return [
        f"{label:<12}{by:<11}{name.replace('_', ' '):<12}AP 3d {ap[label, by, name, '3d']:.3f}"
        f"  bev {ap[label, by, name, 'bev']:.3f}  (objects: {targets})"
        for (label, by, name), targets in sorted(known.items(), key=lambda each: labels.index(each[0][0]))
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
