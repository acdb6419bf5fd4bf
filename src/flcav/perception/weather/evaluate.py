"""How often the weather is named rightly."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flcav.intervals import CONFIDENCE, over_scenes
from flcav.perception.metrics import interval_words
from flcav.perception.task import Evaluated
from flcav.records import LEFT_OUT
from flcav.seeds import stream


@dataclass(frozen=True, kw_only=True)
class Classification(Evaluated):
    """How often each class was named rightly, and what it was taken for."""

    accuracy: float
    low: float | None  # 95 % interval over scenes; None of a single one
    high: float | None
    confidence: float = CONFIDENCE
    recall: Mapping[str, float | None]  # by class; None of one without pictures
    classes: tuple[str, ...]
    confusion: tuple[tuple[int, ...], ...]  # pictures: rows are the truth, columns what was found
    pictures: int
    scenes: int
    nearest: Annotated["Classification | None", LEFT_OUT] = None  # the same of all pictures, see `over_the_whole_space`

    @property
    def score(self) -> float:
        """Return the accuracy."""
        return self.accuracy

    def numbers(self) -> Mapping[str, float]:
        """Return the accuracy on pictures within the classes' regions, and on all where they were asked for."""
        nearest = {} if self.nearest is None else {"nearest class": self.nearest.accuracy}
        return {"accuracy": self.accuracy, **nearest}

    def lines(self) -> list[str]:
        """Return accuracy, then recall and confusions class by class."""
        interval = interval_words(self.low, self.high)
        if self.low is not None:
            interval += f" ({100 * self.confidence:g} %, over scenes)"
        seen = f"{self.pictures} pictures of {self.scenes} scenes"
        lines = [f"{seen}: accuracy {self.accuracy:.3f} {interval}"]
        for name, row in zip(self.classes, self.confusion, strict=True):
            recall = self.recall[name]
            taken = [f"{other} {count}" for other, count in zip(self.classes, row) if count and other != name]
            known = "no pictures" if recall is None else f"recall {recall:.3f} of {sum(row)}"
            lines.append(f"{name:<12}{known}" + (f"; taken for {', '.join(taken)}" if taken else ""))
        return lines


def classification(
    truth: NDArray[np.int64], found: NDArray[np.int64], scenes: Sequence[str], classes: Sequence[str], seed: int = 0
) -> Classification:
    """Return accuracy with its 95 % interval over scenes, recall per class, and the confusion matrix.

    `truth` and `found` are (N,) class numbers. Scenes are redrawn whole, since their pictures are alike.
    """
    confusion = np.zeros((len(classes), len(classes)), np.int64)
    np.add.at(confusion, (truth, found), 1)
    low, high = _interval(truth == found, scenes, seed)
    recall = {
        name: float(row[i] / row.sum()) if row.sum() else None for i, (name, row) in enumerate(zip(classes, confusion))
    }
    return Classification(
        accuracy=float((truth == found).mean()),
        low=low,
        high=high,
        recall=recall,
        classes=tuple(classes),
        confusion=tuple(map(tuple, confusion.tolist())),
        pictures=len(truth),
        scenes=len(set(scenes)),
    )


def _interval(right: NDArray[np.bool_], scenes: Sequence[str], seed: int) -> tuple[float, float] | tuple[None, None]:
    if len(set(scenes)) < 2:
        return None, None
    return over_scenes(lambda times: times @ right / times.sum(axis=1), scenes, rng=stream(seed, "bootstrap"))
