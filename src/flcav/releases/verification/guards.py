"""Guards of classes: what a network finds and invents, and what it says of its boxes, on slices of the frames.

The detections of a class are matched to its targets once. Every measure is a sum over detections or targets divided by
another, so that a slice is a choice of rows, and a bootstrap sample weights the frames. `MEASURES` are all of them,
with the limits that `comparison` judges them by. Errors and variances are of the detections that find a target.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate, wrap_angle
from flcav.perception.errors import THRESHOLD
from flcav.perception.metrics.operating_point import DISTANCES_M
from flcav.releases.verification.comparison import (
    LEAST_TARGETS,
    GuardPair,
    Limit,
    Mask,
    MeasuredNetwork,
    Times,
    Values,
    match_detections,
)

OVERLAP = 0.5  # IoU in 3D from which a detection finds a target
SECTORS_DEG = ((-90, -30), (-30, 0), (0, 30), (30, 90))  # of azimuth, counter-clockwise from straight ahead
LEAST_SIGMAS = 0.01
PARTS = ("x", "y", "height above ground", "length", "width", "height", "axis")  # of a box, LiDAR frame


@dataclass(frozen=True)
class Rows:
    """Where N detections or targets of a class are, and how long they are."""

    frame: NDArray[np.int64]  # (N,)
    distance: Values  # (N,) in the plane [m]
    azimuth: Values  # (N,) [degrees]
    length: Values  # (N,) [m]


@dataclass(frozen=True)
class ClassTable:
    """The D detections of one class that count, and its T targets, over F frames."""

    frames: int
    detections: Rows
    score: Values  # (D,)
    right: Mask  # (D,) whether it finds a target
    error: Values  # (D, 7) x, y, z, length, width, height [m], yaw [rad] minus the target's; 0 where it finds none
    variance: Values | None  # (D, 7) predicted, of the same
    targets: Rows
    seen: Values  # (T,) score of the detection that finds it; 0: none

    @property
    def used(self) -> Mask:
        """Return (D,) whether a detection has the score of use."""
        return self.score >= THRESHOLD

    @property
    def axis_error(self) -> Values:
        """Return (D, 7) the errors with yaw as that of the axis, in [-pi/2, pi/2): the heading is another measure."""
        return np.column_stack((self.error[:, :6], wrap_angle(2 * self.error[:, 6]) / 2))


@dataclass(frozen=True)
class MeasureTerms:
    """What N rows add to the numerator and to the denominator of a measure."""

    rows: Rows
    above: Values  # (N,)
    below: Values | None  # (N,); None: the denominator is the number of frames


@dataclass(frozen=True)
class ClassMeasure:
    """A measure of a class, and the limit of the candidate's."""

    by: str
    name: str  # "" where `by` says it
    limit: Limit
    terms: Callable[[ClassTable], MeasureTerms]
    everywhere: bool = False  # on every slice and in every condition, else on distances alone


@dataclass(frozen=True)
class Slice:
    """A part of the rows and of the F frames."""

    name: str
    rows: Callable[[Rows], Mask]
    frames: Mask


def tabulate(measured: MeasuredNetwork, label: str) -> ClassTable:
    """Return the table of one class that has targets."""
    tested = measured.tested
    boxes, targets, errors, rights, seen = [], [], [], [], []
    for each, detections, truth in zip(measured.overlaps[label], tested.detections, tested.truths, strict=True):
        own, wanted = detections[each.detections], truth.targets[each.targets]
        found = match_detections(each, OVERLAP, np.ones(len(wanted), bool), np.arange(len(own)))
        hit = found >= 0
        error, score = np.zeros((len(own), 7)), np.zeros(len(wanted))
        error[hit] = own.array()[hit] - wanted.array()[found[hit]]
        score[found[hit]] = each.score[hit]
        counts = hit | ~each.neutral
        boxes.append(own[counts])
        errors.append(error[counts])
        rights.append(hit[counts])
        targets.append(wanted)
        seen.append(score)
    every = concatenate(boxes)
    return ClassTable(
        frames=len(boxes),
        detections=_locate(boxes),
        score=np.zeros(len(every)) if every.score is None else every.score,
        right=np.concatenate(rights),
        error=np.concatenate(errors),
        variance=every.variance,
        targets=_locate(targets),
        seen=np.concatenate(seen),
    )


def pair_classes(
    driving: MeasuredNetwork, candidate: MeasuredNetwork, condition: str = "", groups: Sequence[tuple[str, Mask]] = ()
) -> Iterator[GuardPair]:
    """Yield the pairs of every measure of each class, on all rows and slice by slice.

    condition: of the sensor; what is found and invented is measured there, in all. groups: slices of the frames, by
    name.
    """
    scene = np.array([truth.scene for truth in driving.tested.truths])
    all_frames = np.ones(len(scene), bool)
    whole = Slice(condition, lambda rows: np.ones(len(rows.frame), bool), all_frames)
    far = [Slice(f"{a}-{b} m", _between("distance", a, b), all_frames) for a, b in DISTANCES_M]
    sectors = [Slice(f"{a} to {b} degrees", _between("azimuth", a, b), all_frames) for a, b in SECTORS_DEG]
    known = [Slice(name, lambda rows, own=inside: own[rows.frame], inside) for name, inside in groups]
    for label in driving.overlaps:
        tables = tabulate(driving, label), tabulate(candidate, label)
        long = float(np.median(tables[0].targets.length)) if len(tables[0].seen) else 0.0
        sizes = [
            Slice("shorter half", _between("length", 0, long), all_frames),
            Slice("longer half", _between("length", long, np.inf), all_frames),
        ]
        for measure in MEASURES:
            if measure.by == "variance" and any(table.variance is None for table in tables):
                continue
            if measure.everywhere:
                slices = [whole] if condition else [whole, *far, *sectors, *sizes, *known]
            else:
                slices = [] if condition else [whole, *far]
            for each in slices:
                yield from _pair(measure, label, tables, scene, each)


def _pair(
    measure: ClassMeasure, label: str, tables: tuple[ClassTable, ClassTable], scene: NDArray[np.str_], part: Slice
) -> Iterator[GuardPair]:
    """Yield the pair of a measure on a slice; none where one of the networks has too few rows for it."""
    sums = []
    for table in tables:
        terms = measure.terms(table)
        inside = part.rows(terms.rows)
        frame, above = terms.rows.frame[inside], terms.above[inside]
        below = part.frames.astype(float) if terms.below is None else _sum(frame, terms.below[inside], table.frames)
        sums.append((_sum(frame, above, table.frames), below))
    least = min(int(below.sum()) for _, below in sums)
    if least >= LEAST_TARGETS:
        driving, candidate = (_ratio(*each) for each in sums)
        scenes = min(len(np.unique(scene[below > 0])) for _, below in sums)
        name = " ".join(filter(None, (label, measure.name, part.name)))
        yield GuardPair(measure.by, name, driving, candidate, scene, scenes, least, measure.limit)


def _sum(frame: NDArray[np.int64], values: Values, frames: int) -> Values:
    return np.bincount(frame, values, frames).astype(np.float64)


def _ratio(above: Values, below: Values) -> Callable[[Times], Values]:
    def ratio(times: Times) -> Values:
        with np.errstate(invalid="ignore"):
            return (times @ above) / (times @ below)

    return ratio


def _between(field: str, low: float, high: float) -> Callable[[Rows], Mask]:
    return lambda rows: (getattr(rows, field) >= low) & (getattr(rows, field) < high)


def _locate(parts: Sequence[Boxes]) -> Rows:
    boxes = concatenate(parts)
    x, y, _ = boxes.center.T
    frame = np.repeat(np.arange(len(parts)), [len(each) for each in parts])
    return Rows(frame, np.hypot(x, y), np.degrees(np.arctan2(y, x)), boxes.size[:, 0])


def _found(table: ClassTable) -> MeasureTerms:
    return MeasureTerms(table.targets, (table.seen >= THRESHOLD).astype(float), np.ones(len(table.seen)))


def _false(table: ClassTable) -> MeasureTerms:
    return MeasureTerms(table.detections, (table.used & ~table.right).astype(float), None)


def _precision(table: ClassTable) -> MeasureTerms:
    return MeasureTerms(table.detections, (table.used & table.right).astype(float), table.used.astype(float))


def _confidence(table: ClassTable) -> MeasureTerms:
    """Return the score minus whether it is right, of detections in use: 0 where scores are calibrated."""
    return MeasureTerms(table.detections, table.used * (table.score - table.right), table.used.astype(float))


def _heading(table: ClassTable) -> MeasureTerms:
    return _of_right(table, (1 + np.cos(table.error[:, 6])) / 2)


def _error(part: int) -> Callable[[ClassTable], MeasureTerms]:
    return lambda table: _of_right(table, np.abs(table.axis_error[:, part]))


def _bias(part: int) -> Callable[[ClassTable], MeasureTerms]:
    return lambda table: _of_right(table, table.axis_error[:, part])


def _normalised(part: int) -> Callable[[ClassTable], MeasureTerms]:
    """Return the logarithm of errors in predicted standard deviations, from `LEAST_SIGMAS` on: it has no heavy tail."""

    def normalised(table: ClassTable) -> MeasureTerms:
        assert table.variance is not None
        sigmas = np.abs(table.axis_error[:, part]) / np.sqrt(table.variance[:, part])
        return _of_right(table, np.log(np.maximum(sigmas, LEAST_SIGMAS)))

    return normalised


def _of_right(table: ClassTable, values: Values) -> MeasureTerms:
    return MeasureTerms(table.detections, np.where(table.right, values, 0.0), table.right.astype(float))


MEASURES = (
    ClassMeasure("found", "", Limit(0.6), _found, everywhere=True),
    ClassMeasure("false", "", Limit(2, 0.15, falling=True), _false, everywhere=True),
    ClassMeasure("right", "", Limit(0.5), _precision),
    ClassMeasure("heading", "", Limit(0.8), _heading),
    ClassMeasure("score", "too high", Limit(1, 0.2, falling=True), _confidence),
    ClassMeasure("score", "too low", Limit(1, -0.2), _confidence),
    *(ClassMeasure("error", part, Limit(1.5, 0.05, falling=True), _error(number)) for number, part in enumerate(PARTS)),
    *(
        ClassMeasure("bias", f"{part} too {side}", limit, _bias(number))
        for number, part in enumerate(PARTS)
        for side, limit in (("large", Limit(1, 0.1, falling=True)), ("small", Limit(1, -0.1)))
    ),
    *(
        ClassMeasure("variance", f"{part} too {side}", limit, _normalised(number))
        for number, part in enumerate(PARTS)
        for side, limit in (("small", Limit(1, np.log(2), falling=True)), ("large", Limit(1, -np.log(2))))
    ),
)
