"""How often the weather is named rightly."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.intervals import CONFIDENCE, over_scenes
from flcav.seeds import stream


def classification(
    truth: NDArray[np.int64], found: NDArray[np.int64], scenes: Sequence[str], classes: Sequence[str], seed: int = 0
) -> dict[str, Any]:
    """Return accuracy with its 95 % interval over scenes, recall per class, and the confusion matrix.

    `truth` and `found` are (N,) class numbers. Rows of the matrix are the truth, columns what was found. Scenes are
    redrawn whole, since their pictures are alike; of a single one the interval is None. So is the recall of a class
    without pictures.
    """
    confusion = np.zeros((len(classes), len(classes)), np.int64)
    np.add.at(confusion, (truth, found), 1)
    low, high = _interval(truth == found, scenes, seed)
    recall = {
        name: float(row[i] / row.sum()) if row.sum() else None for i, (name, row) in enumerate(zip(classes, confusion))
    }
    return {
        "accuracy": float((truth == found).mean()),
        "low": low,
        "high": high,
        "confidence": CONFIDENCE,
        "recall": recall,
        "classes": list(classes),
        "confusion": confusion.tolist(),
        "pictures": len(truth),
        "scenes": len(set(scenes)),
    }


def _interval(right: NDArray[np.bool_], scenes: Sequence[str], seed: int) -> tuple[float, float] | tuple[None, None]:
    if len(set(scenes)) < 2:
        return None, None
    return over_scenes(lambda times: times @ right / times.sum(axis=1), scenes, rng=stream(seed, "bootstrap"))
