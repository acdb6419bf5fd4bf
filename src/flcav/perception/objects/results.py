"""The evaluation of an object detector: AP as a whole and by distance, occlusion and weather, and trust in scores."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate
from flcav.perception.metrics import average_precision, interval_words, match
from flcav.perception.objects.area import Rules
from flcav.perception.objects.calibrate import OVERLAP, Trust
from flcav.perception.objects.evaluate import OVERLAPS, Asked, Score, number_or_none, of_class
from flcav.perception.ops.rotated import Kind
from flcav.perception.task import Evaluated
from flcav.perception.tracking.evaluate import TracksEvaluation
from flcav.records import LEFT_OUT, Class
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


@dataclass(frozen=True, kw_only=True)
class ObjectsEvaluation(Evaluated):
    """The scores of one network on one set of frames."""

    frames: int
    scenes: int
    scores: tuple[Score, ...]  # a class after the other
    rules: Annotated[Rules | None, LEFT_OUT] = None  # always there, but in results of before
    slices: tuple[SlicePrecision, ...]
    trust: tuple[Trust, ...]
    tracks: Annotated[TracksEvaluation | None, LEFT_OUT] = None  # where they were asked for

    @property
    def score(self) -> float:
        """Return the mean over classes of AP in 3D at IoU 0.5; 0 where there was nothing to find."""
        known = [row.ap for row in self.scores if (row.kind, row.iou) == ("3d", 0.5) and row.ap]
        return float(np.mean(known)) if known else 0.0

    def numbers(self) -> Mapping[str, float]:
        """Return AP in 3D and from above of each class, AOS, headings, the error of calibration, MOTA of tracks."""
        ap = {f"{row.label} AP {row.kind} at {row.iou}": row.ap for row in self.scores}
        headings = {
            f"{row.label} {name}": value
            for row in self.scores
            if (row.kind, row.iou) == ("3d", 0.5)
            for name, value in (("AOS 3d at 0.5", row.aos), ("right headings", row.right_headings))
        }
        errors = {f"{row.label} calibration error": row.ece for row in self.trust}
        tracks = {
            f"{row.label} {name}": value
            for row in (self.tracks.scores if self.tracks else ())
            for name, value in (("MOTA", row.mota), ("AMOTA", row.amota))
        }
        return {name: value for name, value in (ap | headings | errors | tracks).items() if value is not None}

    def lines(self) -> list[str]:
        """Return one line per class, kind of overlap and IoU, one per class and slice, and those of tracks."""
        lines = [f"{self.frames} frames of {self.scenes} scenes", *(self.rules.lines() if self.rules else ())]
        for row in self.scores:
            found = "nothing to find"
            if row.ap is not None:
                found = f"AP {row.ap:.3f} {interval_words(row.low, row.high)}  AOS {row.aos:.3f}"
            if row.right_headings is not None:
                found += f", {row.right_headings:.0%} of those found head the right way"
            counts = f"objects: {row.targets}, and {row.hidden} without a return"
            lines.append(f"{row.label:<12}{row.kind:>4} IoU {row.iou:.1f}  {found}  ({counts})")
        lines += [f"at IoU {OVERLAP:g} by distance, occlusion and weather:", *slice_lines(self.slices, OVERLAP)]
        for row in self.trust:
            if row.ece is not None:
                lines.append(f"{row.label:<12}expected calibration error {row.ece:.3f}")
        return [*lines, *(self.tracks.lines() if self.tracks else ())]
