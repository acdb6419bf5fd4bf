"""Guards of classes: recall, false detections, box errors and predicted variances, on slices of the frames.

The detections of a class are matched to its targets once. Every measure is a ratio of two sums over detections or
targets, so that a slice selects rows, and a bootstrap sample weights frames. `MEASURES` lists all of them, with the
limits that `comparison` applies. Errors and variances are those of detections with a matched target.
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

OVERLAP = 0.5  # lowest IoU in 3D of a match
SECTORS_DEG = ((-90, -30), (-30, 0), (0, 30), (30, 90))  # of azimuth, counter-clockwise from the forward axis
LEAST_SIGMAS = 0.01  # lower bound of normalised errors, whose logarithm is taken
PARTS = ("x", "y", "height above ground", "length", "width", "height", "axis")  # of a box, LiDAR frame


@dataclass(frozen=True)
class Rows:
    """Frames, positions and lengths of N detections or targets of a class, LiDAR frame."""

    frame: NDArray[np.int64]  # (N,)
    distance: Values  # (N,) in the plane [m]
    azimuth: Values  # (N,) [degrees]
    length: Values  # (N,) [m]


@dataclass(frozen=True)
class ClassTable:
    """The D counted detections of one class and its T targets, over F frames."""

    frames: int
    detections: Rows
    score: Values  # (D,)
    right: Mask  # (D,) whether it matches a target
    error: Values  # (D, 7) x, y, z, length, width, height [m], yaw [rad] minus the target's; 0 without a match
    variance: Values | None  # (D, 7) predicted, of the same quantities [m^2], [rad^2]
    targets: Rows
    seen: Values  # (T,) score of the matched detection; 0: none

    @property
    def used(self) -> Mask:
        """Return whether detections (D,) reach the score threshold in use."""
        return self.score >= THRESHOLD

    @property
    def axis_error(self) -> Values:
        """Return the errors (D, 7) with yaw modulo pi, in [-pi/2, pi/2), since the heading has a separate measure."""
        return np.column_stack((self.error[:, :6], wrap_angle(2 * self.error[:, 6]) / 2))


@dataclass(frozen=True)
class MeasureTerms:
    """The terms of N rows in the numerator and the denominator of a measure."""

    rows: Rows
    above: Values  # (N,)
    below: Values | None  # (N,); None: the denominator is the number of frames


@dataclass(frozen=True)
class ClassMeasure:
    """A measure of a class, with its limit for the candidate."""

    by: str
    name: str  # "" where `by` is enough
    limit: Limit
    terms: Callable[[ClassTable], MeasureTerms]
    everywhere: bool = False  # on every slice and in every condition, else only by distance


@dataclass(frozen=True)
class Slice:
    """A slice: some of the rows, and some of the F frames."""

    name: str
    rows: Callable[[Rows], Mask]
    frames: Mask


def tabulate(measured: MeasuredNetwork, label: str) -> ClassTable:
    """Return the table of a class with targets."""
    tested = measured.tested
    boxes, targets, errors, rights, seen = [], [], [], [], []
    for each, detections, truth in zip(measured.overlaps[label], tested.detections, tested.truths, strict=True):
        boxes_of_class, wanted = detections[each.detections], truth.targets[each.targets]
        found = match_detections(each, OVERLAP, np.ones(len(wanted), bool), np.arange(len(boxes_of_class)))
        hit = found >= 0
        error, score = np.zeros((len(boxes_of_class), 7)), np.zeros(len(wanted))
        error[hit] = boxes_of_class.array()[hit] - wanted.array()[found[hit]]
        score[found[hit]] = each.score[hit]
        counts = hit | ~each.neutral
        boxes.append(boxes_of_class[counts])
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
    """Yield the pairs of all measures by class, on all rows and on slices.

    condition: of the sensor, in which only recall and false detections on all rows are measured. groups: slices of
    frames, as name and mask (F,).
    """
    scene = np.array([truth.scene for truth in driving.tested.truths])
    all_frames = np.ones(len(scene), bool)
    whole = Slice(condition, lambda rows: np.ones(len(rows.frame), bool), all_frames)
    far = [Slice(f"{a}-{b} m", _between("distance", a, b), all_frames) for a, b in DISTANCES_M]
    sectors = [Slice(f"{a} to {b} degrees", _between("azimuth", a, b), all_frames) for a, b in SECTORS_DEG]
    known = [Slice(name, lambda rows, mask=inside: mask[rows.frame], inside) for name, inside in groups]
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
    """Yield the pair of a measure on a slice; none if one of the networks has too few rows."""
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
    """Return the score minus correctness of detections in use, whose mean is 0 for calibrated scores."""
    return MeasureTerms(table.detections, table.used * (table.score - table.right), table.used.astype(float))


def _heading(table: ClassTable) -> MeasureTerms:
    return _of_right(table, (1 + np.cos(table.error[:, 6])) / 2)


def _error(part: int) -> Callable[[ClassTable], MeasureTerms]:
    return lambda table: _of_right(table, np.abs(table.axis_error[:, part]))


def _bias(part: int) -> Callable[[ClassTable], MeasureTerms]:
    return lambda table: _of_right(table, table.axis_error[:, part])


def _normalised(part: int) -> Callable[[ClassTable], MeasureTerms]:
    """Return the log of errors over predicted standard deviations, at least `LEAST_SIGMAS`: it has no heavy tail."""

    def normalised(table: ClassTable) -> MeasureTerms:
        assert table.variance is not None
        sigmas = np.abs(table.axis_error[:, part]) / np.sqrt(table.variance[:, part])
        return _of_right(table, np.log(np.maximum(sigmas, LEAST_SIGMAS)))

    return normalised


def _of_right(table: ClassTable, values: Values) -> MeasureTerms:
    return MeasureTerms(table.detections, np.where(table.right, values, 0.0), table.right.astype(float))


# limits are loose, since guards only protect against large losses: see `comparison`
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
