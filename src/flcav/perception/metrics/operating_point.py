"""Counts of found objects and false detections at one score, the operating point: for near cars, and by distance.

Intervals are bootstrap intervals over scenes or, where all frames are of one scene, over frames; the latter are too
narrow where frames follow one another.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flcav.arrays import Array, Ints, Mask
from flcav.geometry import Boxes
from flcav.perception.metrics.detection import assign_targets, on_neutral
from flcav.perception.ops.boxes import Kind
from flcav.statistics.bootstrap import bootstrap_over_scenes
from flcav.storage.records import Class

DISTANCES_M = ((0, 20), (20, 40), (40, 80))  # from, to: horizontal distance from the LiDAR to the centre of the box
OVERLAP = 0.5  # IoU in 3D from which a detection finds an object


@dataclass(frozen=True)
class FoundAtDistance:
    """The targets of a class in a range of distances, the number found, and the false detections there."""

    label: Class
    distance_m: tuple[int, int]  # from, to
    targets: int
    found: int  # of these targets
    recall: tuple[float, float] | None  # 95 % interval of the share found; None where resamples have no targets
    false_a_frame: float
    false: tuple[float, float]  # its 95 % interval

    def describe(self) -> str:
        """Return the counts in words."""
        low, high = self.distance_m
        share = "" if self.recall is None else f" [{self.recall[0]:.2f}, {self.recall[1]:.2f}]"
        found = f"{self.found} of {self.targets} found{share}"
        false = f"{self.false_a_frame:.2f} false a frame [{self.false[0]:.2f}, {self.false[1]:.2f}]"
        return f"{self.label:<12}{f'{low}-{high} m':<9}{found}, {false}"


def count_by_distance(
    detections: Sequence[Boxes],
    targets: Sequence[Boxes],
    neutral: Sequence[Boxes],
    scene_of_frame: Sequence[str],
    label: str,
    rng: np.random.Generator,
) -> Iterator[FoundAtDistance]:
    """Yield the numbers of found objects and false detections of a class over F frames, by distance and in total.

    All boxes are of that class, in the LiDAR's frame. In each frame a detection of `SCORE` or more, in order of score,
    finds the target that it overlaps most, as in `match`; one on a neutral object is neither true nor false. A target
    and a false detection count at their distances. Raises ValueError where detections have no scores.
    """
    unit = np.arange(len(targets)) if len(set(scene_of_frame)) < 2 else np.asarray(scene_of_frame)
    frames = [_count_frame(*frame) for frame in zip(detections, targets, neutral, strict=True)]
    for span in (*DISTANCES_M, (DISTANCES_M[0][0], DISTANCES_M[-1][1])):
        counts = np.array([[_within(part, span) for part in frame] for frame in frames]).reshape(-1, 3)
        wanted, found, false = counts.sum(axis=0).tolist()
        if wanted or false:
            recall = _interval(counts[:, 1], counts[:, 0], unit, rng) if wanted else None
            wrong = _interval(counts[:, 2], np.ones(len(counts)), unit, rng)
            assert wrong is not None  # every resample has frames
            yield FoundAtDistance(label, span, wanted, found, recall, round(false / len(counts), 6), wrong)


def describe_counts(counts: Sequence[FoundAtDistance]) -> list[str]:
    """Return the counts of found objects and false detections in words: a line per class and range of distances."""
    return [f"at a score of {SCORE:g} and 3D IoU {OVERLAP:g}, by distance:", *(row.describe() for row in counts)]


def _count_frame(seen: Boxes, wanted: Boxes, others: Boxes, kind: Kind = "3d") -> tuple[NDArray, NDArray, NDArray]:
    """Return the distances [m] of a frame's targets, of those found, and of false detections."""
    if seen.score is None and len(seen):
        raise ValueError("detections without scores cannot be counted")
    kept = seen if seen.score is None else seen[seen.score >= SCORE]
    matched = assign_targets(kept, wanted, OVERLAP, kind)
    away, far = (np.hypot(boxes.center[:, 0], boxes.center[:, 1]) for boxes in (wanted, kept))
    return away, away[matched[matched >= 0]], far[(matched < 0) & ~on_neutral(kept, others)]


def _within(distance: NDArray, span: tuple[int, int]) -> int:
    return int(((distance >= span[0]) & (distance < span[1])).sum())


def _interval(part: NDArray, whole: NDArray, unit: ArrayLike, rng: np.random.Generator) -> tuple[float, float] | None:
    """Return the 95 % interval of the ratio of two sums over frames; None where a resample has none of `whole`."""

    def ratio(times: Ints) -> Array:
        below = times @ whole
        return np.where(below > 0, (times @ part) / np.maximum(below, 1), np.nan)

    low, high = bootstrap_over_scenes(ratio, unit, rng=rng)
    return None if np.isnan(low) else (round(low, 6), round(high, 6))


WITHIN_M = 40.0  # largest horizontal distance from the LiDAR to the centre of a box
SCORE = 0.3  # lowest score of a detection that counts


@dataclass(frozen=True)
class FoundCars:
    """The targets of class Car near the LiDAR, summed over frames, the number found, and the false detections."""

    cars: int  # within `within_m`, counted once per frame
    found: int  # of these cars
    false_per_quarter_turn: float  # false cars within `within_m`, by frame and look; around there are four looks
    within_m: float = WITHIN_M
    score: float = SCORE
    overlap: float = OVERLAP

    def __str__(self) -> str:
        return (
            f"cars within {self.within_m:g} m, at a score of {self.score:g} and bird's-eye IoU {self.overlap:g}: found "
            f"{self.found} of {self.cars}, and {self.false_per_quarter_turn:.2f} false ones a quarter turn"
        )


def count_found_cars(
    detections: Sequence[Boxes], targets: Sequence[Boxes], neutral: Sequence[Boxes], *, looks: int = 1
) -> FoundCars:
    """Return the numbers of cars found and of false detections over F frames, over which the three sequences run.

    All boxes are cars, in the LiDAR's frame. In each frame a detection, in order of score, finds the target that it
    overlaps most, as in `match`; one on a neutral object is neither true nor false. `looks` is the number of quarter
    turns that the network looked at in each frame, 1 or 4. Raises ValueError where there are no frames, or detections
    without scores.
    """
    if not detections:
        raise ValueError("cars of 0 frames cannot be counted")
    frames = [_count_frame(*frame, "bev") for frame in zip(detections, targets, neutral, strict=True)]
    cars, found, false = (sum(int((away < WITHIN_M).sum()) for away in part) for part in zip(*frames))
    return FoundCars(cars, found, round(false / (len(detections) * looks), 6))


def is_near(boxes: Boxes) -> Mask:
    """Return the mask (N,) of boxes, in the LiDAR's frame, with their centre within `WITHIN_M` of the LiDAR."""
    return np.hypot(boxes.center[:, 0], boxes.center[:, 1]) < WITHIN_M
