"""95 % confidence intervals: the percentile bootstrap over scenes and Student's t over seeds.

Frames of one scene share their traffic, so the bootstrap resamples whole scenes (Efron and Tibshirani, "An Introduction
to the Bootstrap", 1993, ch. 13: percentile intervals). Results of different seeds are independent but few: Student's t.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

CONFIDENCE = 0.95
REDRAWS = 1000
TAILS = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)


@dataclass(frozen=True)
class Estimate:
    """An estimate with its 95 % confidence interval; `low` and `high` are None where one scene or seed gives none."""

    mean: float
    low: float | None
    high: float | None

    def describe(self, *, sign: bool = False) -> str:
        """Return the text "mean (low to high)" with three decimals; only the mean where there is no interval.

        With `sign`, positive numbers have a plus.
        """
        form = "+.3f" if sign else ".3f"
        if self.low is None or self.high is None:
            return f"{self.mean:{form}}"
        return f"{self.mean:{form}} ({self.low:{form}} to {self.high:{form}})"


@dataclass(frozen=True)
class MeanOverSeeds(Estimate):
    """The mean over seeds with Student's 95 % confidence interval, of zero width for a single seed."""

    low: float
    high: float


def bootstrap_over_scenes(
    measure: Callable[[NDArray[np.int64]], NDArray[np.float64]],
    scene_of_frame: ArrayLike,
    n: int = REDRAWS,
    *,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Return the ends of the 95 % percentile interval of a measure, from `n` bootstrap resamples of the scenes.

    `measure` takes (n, F) counts, how often each of F frames is in each resample, and returns (n,) values, NaN where it
    is undefined; such resamples are left out, and both ends are NaN where none is left. `scene_of_frame` (F,) names
    the scene of each frame.
    """
    names, scene = np.unique(np.asarray(scene_of_frame), return_inverse=True)
    times = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=n)
    draws = measure(times[:, scene])
    known = draws[np.isfinite(draws)]
    if not len(known):
        return float("nan"), float("nan")
    low, high = np.quantile(known, TAILS)
    return float(low), float(high)


def mean_over_seeds(values: Sequence[float]) -> MeanOverSeeds:
    """Return the mean of `values`, one per seed, and its 95 % interval: mean ± t(n - 1, 97.5 %) · s / √n."""
    array = np.asarray(values, dtype=np.float64)
    half = 0.0
    if len(array) > 1:
        half = float(stdtrit(len(array) - 1, TAILS[1]) * array.std(ddof=1) / np.sqrt(len(array)))
    return MeanOverSeeds(float(array.mean()), float(array.mean()) - half, float(array.mean()) + half)
