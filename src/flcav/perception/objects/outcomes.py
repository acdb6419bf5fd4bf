"""Matches of an object detector per test frame, kept to recompute average precision on resampled scenes."""

from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.foreground import frame_reader
from flcav.perception.metrics import Matches, match, orientation_similarity, right_headings, weighted_precision
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_frames
from flcav.perception.objects.truth import select_class
from flcav.perception.ops.rotated import Kind
from flcav.perception.outcomes import Measure, Outcomes, Times, Values
from flcav.statistics.bootstrap import REDRAWS

CLASSES, HIDDEN = "classes", "hidden"
MEASURED = "3d50"
KEPT: Mapping[str, tuple[Kind, float]] = {MEASURED: ("3d", 0.5), "3d70": ("3d", 0.7), "bev50": ("bev", 0.5)}


class ObjectsOutcomes:
    """Mean average precision: AP|R40 in 3D at IoU 0.5, the mean over classes, from matches kept per frame."""

    measure_name = "AP50"
    redraws = REDRAWS

    def outcomes(
        self, network: Second, data: Dataset, frames: Sequence[int], progress: Report = ignore_progress
    ) -> Outcomes:
        """Return the matches of each class and kind of overlap (`KEPT`), by frame, and the number of hidden objects.

        Raises `InputError` where there are no frames, or one has no LiDAR.
        """
        found, truths = detect_frames(
            network, map(frame_reader(data, network.config.foreground), frames), total=len(frames), progress=progress
        )
        classes = network.config.classes
        if not truths:
            raise InputError("evaluation on 0 frames: at least one is wanted")
        hidden = [sum(int((truth.hidden.label == name).sum()) for truth in truths) for name in classes]
        arrays: dict[str, NDArray] = {CLASSES: np.array(classes), HIDDEN: np.array(hidden)}
        for name in classes:
            own = [select_class(boxes, name) for boxes in found]
            targets = [select_class(truth.targets, name) for truth in truths]
            neutral = [select_class(truth.neutral, name) for truth in truths]
            for key, (kind, overlap) in KEPT.items():
                matches = match(own, targets, neutral, overlap, kind)
                arrays |= {f"{name}/{key}/{field}": value for field, value in vars(matches).items()}
        return Outcomes(np.array([truth.scene for truth in truths]), arrays)

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return (n,) the mean AP over the classes with targets, for each of n resamples of the frames `times` (n, F).

        NaN where no class has targets.
        """
        return self._mean_precision(outcomes, MEASURED, times)

    @property
    def further_measures(self) -> Mapping[str, Measure]:
        """Return AP in 3D at IoU 0.7, for which boxes have to be accurate."""
        return {"AP70": lambda outcomes, times: self._mean_precision(outcomes, "3d70", times)}

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return further metrics by name, means over the classes with targets; None where there are none.

        AP in 3D at IoU 0.7 and in bird's-eye view at 0.5, AOS, the share of right headings, and the numbers of targets
        and hidden objects.
        """
        once = np.ones((1, len(outcomes.scene)), dtype=np.int64)
        each = [read_matches(outcomes, name) for name in outcomes.arrays[CLASSES]]
        known = [matches for matches in each if matches.targets.any()]
        right = [share for matches in known if not np.isnan(share := right_headings(matches))]
        return {
            "AP70": _number(self._mean_precision(outcomes, "3d70", once)[0]),
            "BEV AP50": _number(self._mean_precision(outcomes, "bev50", once)[0]),
            "AOS50": float(np.mean([orientation_similarity(matches) for matches in known])) if known else None,
            "right headings": float(np.mean(right)) if right else None,
            "targets": float(sum(int(matches.targets.sum()) for matches in each)),
            "hidden": float(outcomes.arrays[HIDDEN].sum()),
        }

    def _mean_precision(self, outcomes: Outcomes, key: str, times: Times) -> Values:
        each = [weighted_precision(read_matches(outcomes, name, key), times) for name in outcomes.arrays[CLASSES]]
        known = ~np.isnan(each)
        with np.errstate(invalid="ignore"):
            return np.where(known, each, 0.0).sum(axis=0) / known.sum(axis=0)


def read_matches(outcomes: Outcomes, name: str, key: str = MEASURED) -> Matches:
    """Return the matches of class `name` for the kind of overlap and IoU `key`, one of `KEPT`."""
    return Matches(**{field.name: outcomes.arrays[f"{name}/{key}/{field.name}"] for field in fields(Matches)})


def join_outcomes(parts: Sequence[Outcomes]) -> Outcomes:
    """Return the outcomes of one network on the frames of several tests, one after the other, as of one test.

    Scenes of different parts are different scenes: their names begin with the number of the part.
    """
    scenes = np.array([f"{number}/{scene}" for number, each in enumerate(parts) for scene in each.scene])
    arrays: dict[str, NDArray] = {
        CLASSES: parts[0].arrays[CLASSES],
        HIDDEN: np.sum([each.arrays[HIDDEN] for each in parts], axis=0),
    }
    before = np.cumsum([0, *(len(each.scene) for each in parts)])
    for label in parts[0].arrays[CLASSES]:
        for key in KEPT:
            own = [read_matches(part, str(label), key) for part in parts]
            columns = [vars(each) for each in own]
            joined = {name: np.concatenate([each[name] for each in columns]) for name in columns[0]}
            joined["frame"] = np.concatenate([each.frame + first for each, first in zip(own, before)])
            order = np.argsort(-joined["score"], kind="stable")
            joined |= {name: joined[name][order] for name in ("score", "hit", "turned", "frame")}
            arrays |= {f"{label}/{key}/{name}": value for name, value in joined.items()}
    return Outcomes(scenes, arrays)


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
