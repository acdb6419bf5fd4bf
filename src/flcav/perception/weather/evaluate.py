"""How often the weather is named rightly."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.perception.metrics import CONFIDENCE
from flcav.seeds import stream

REDRAWS = 1000


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
    _, scene = np.unique(np.asarray(scenes), return_inverse=True)
    count = int(scene.max()) + 1
    if count < 2:
        return None, None
    hits, sizes = np.bincount(scene, right), np.bincount(scene)
    times = stream(seed, "bootstrap").multinomial(count, np.full(count, 1 / count), size=REDRAWS)
    low, high = np.quantile(times @ hits / (times @ sizes), ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return float(low), float(high)
