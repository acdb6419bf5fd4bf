"""Means over seeds with Student's 95 % intervals: what training and traffic vary is in them."""

from collections.abc import Sequence

import numpy as np
from scipy import stats


def mean_over_seeds(values: Sequence[float]) -> dict[str, float]:
    """Return mean, low and high of `values`, one per seed; an interval without width for a single one."""
    array = np.asarray(values, dtype=np.float64)
    half = 0.0
    if len(array) > 1:
        half = float(stats.t.ppf(0.975, len(array) - 1) * array.std(ddof=1) / np.sqrt(len(array)))
    return {"mean": float(array.mean()), "low": float(array.mean()) - half, "high": float(array.mean()) + half}
