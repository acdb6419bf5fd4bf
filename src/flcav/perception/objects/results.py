"""How good a network is at finding objects: average precision, where that is hard and easy, and trust in scores."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from flcav.perception.metrics import interval_words
from flcav.perception.objects.area import Rules
from flcav.perception.objects.calibrate import OVERLAP, Trust
from flcav.perception.objects.evaluate import Score
from flcav.perception.objects.slices import SlicePrecision, slice_lines
from flcav.perception.task import Evaluated
from flcav.perception.tracking.evaluate import TracksEvaluation
from flcav.records import LEFT_OUT


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
