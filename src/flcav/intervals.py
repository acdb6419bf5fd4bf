"""95 % confidence intervals: the percentile bootstrap over scenes and Student's t over seeds.

Frames of one scene share their traffic, so the bootstrap resamples whole scenes (Efron and Tibshirani, "An Introduction
to the Bootstrap", 1993, ch. 13: percentile intervals). Results of different seeds are independent but few: Student's t.
A single training adds the spread of retraining: its network is one draw of those that other random numbers would give.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit, stdtrit

CONFIDENCE = 0.95
REDRAWS = 1000
TAILS = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)
EDGE = 1e-6  # log-odds are taken of shares this far from 0 and 1


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


@dataclass(frozen=True)
class Spread:
    """The standard deviation of a number over trainings on the same frames with other random numbers."""

    sd: float
    trainings: int  # that the standard deviation was estimated from, at least 2

    @property
    def half_width(self) -> float:
        """Half the width of the 95 % interval for the mean over trainings, around one training: t(n - 1) · sd."""
        return float(stdtrit(self.trainings - 1, TAILS[1])) * self.sd


def measure_spread(values: Sequence[float]) -> Spread | None:
    """Return the spread of the trainings' `values`; None for fewer than two."""
    return Spread(float(np.std(values, ddof=1)), len(values)) if len(values) > 1 else None


def widen(estimate: Estimate, spread: Spread) -> Estimate:
    """Return an estimate of one training with the interval for the mean over trainings.

    Scenes and training vary independently, so that on either side the half-widths add in quadrature:
    sqrt(scenes^2 + (t · sd)^2). An estimate without an interval stays as it is.
    """
    if estimate.low is None or estimate.high is None:
        return estimate
    below, above = estimate.mean - estimate.low, estimate.high - estimate.mean
    half = spread.half_width
    return Estimate(estimate.mean, estimate.mean - np.hypot(below, half), estimate.mean + np.hypot(above, half))


def widen_share(estimate: Estimate, spread: Spread) -> Estimate:
    """Return `widen` of a number in [0, 1] on the scale of its log-odds, so that the interval stays inside [0, 1].

    The spread on that scale is sd / (p (1 - p)) (delta method). An estimate of 0 or 1 stays as it is.
    """
    p, low, high = estimate.mean, estimate.low, estimate.high
    if low is None or high is None or not 0 < p < 1:
        return estimate
    odds = Estimate(*logit(np.clip([p, low, high], EDGE, 1 - EDGE)).tolist())
    wide = widen(odds, Spread(spread.sd / (p * (1 - p)), spread.trainings))
    return Estimate(p, *expit([wide.low, wide.high]).tolist())


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
