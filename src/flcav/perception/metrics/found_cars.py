"""Cars near the LiDAR that a detector finds, and those it invents, at one score: the count of an operating point."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.perception.metrics.matching import assign_targets, on_neutral

WITHIN_M = 40.0  # in the plane from the LiDAR to the centre of a box
SCORE = 0.3  # lowest of a detection that counts
OVERLAP = 0.5  # bird's-eye IoU from which a detection finds a car


@dataclass(frozen=True)
class FoundCars:
    """The targets of class Car near the LiDAR, summed over frames, those found of them, and false detections."""

    cars: int  # within `within_m`, each once a frame
    found: int  # of these
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
    """Return how many cars were found and invented over F frames, of which the three sequences are; all boxes are cars.

    In each frame a detection, in order of score, finds the target that it overlaps most, as in `match`; one on a
    neutral object is neither true nor false. looks: quarter turns that the network looked at in each frame, 1 or 4.
    Boxes are in the LiDAR's frame. Raises ValueError where there are no frames, or detections without scores.
    """
    if not detections:
        raise ValueError("cars of 0 frames cannot be counted")
    cars = found = false = 0
    for seen, wanted, others in zip(detections, targets, neutral, strict=True):
        if seen.score is None and len(seen):
            raise ValueError("detections without scores cannot be counted")
        kept = seen if seen.score is None else seen[seen.score >= SCORE]
        matched, near = assign_targets(kept, wanted, OVERLAP, "bev"), _is_near(wanted)
        cars += int(near.sum())
        found += int(near[matched[matched >= 0]].sum())
        false += int(((matched < 0) & _is_near(kept) & ~on_neutral(kept, others)).sum())
    return FoundCars(cars, found, round(false / (len(detections) * looks), 6))


def _is_near(boxes: Boxes) -> NDArray[np.bool_]:
    return np.hypot(boxes.center[:, 0], boxes.center[:, 1]) < WITHIN_M
