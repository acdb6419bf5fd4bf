"""Intervals of what is measured: the bootstrap over scenes, and Student's over seeds.

Frames of one scene share their traffic, so whole scenes are redrawn (Efron and Tibshirani, "An Introduction to the
Bootstrap", 1993, ch. 13: percentile intervals). Seeds differ in training and traffic, and are few: Student's t.
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
    """A number with its 95 % interval, which is None where one scene or one seed leaves it unknown."""

    mean: float
    low: float | None
    high: float | None

    def told(self, *, sign: bool = False) -> str:
        """Return "mean (low to high)", with their signs if asked; the mean alone where the interval is unknown."""
        form = "+.3f" if sign else ".3f"
        if self.low is None or self.high is None:
            return f"{self.mean:{form}}"
        return f"{self.mean:{form}} ({self.low:{form}} to {self.high:{form}})"


@dataclass(frozen=True)
class MeanOverSeeds(Estimate):
    """A mean over seeds with Student's 95 % interval, which has no width of a single one."""

    low: float
    high: float


def over_scenes(
    measure: Callable[[NDArray[np.int64]], NDArray[np.float64]],
    scene_of_frame: ArrayLike,
    n: int = REDRAWS,
    *,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Return the 95 % percentile interval of a measure under `n` redrawings of the scenes; NaN where it is never known.

    `measure` takes (n, F), how often each frame counts in each redrawing, and returns (n,) values, NaN where it is not
    defined; `scene_of_frame` (F,) names each frame's scene.
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
    """Return the mean of `values`, one per seed."""
    array = np.asarray(values, dtype=np.float64)
    half = 0.0
    if len(array) > 1:
        half = float(stdtrit(len(array) - 1, TAILS[1]) * array.std(ddof=1) / np.sqrt(len(array)))
    return MeanOverSeeds(float(array.mean()), float(array.mean()) - half, float(array.mean()) + half)
