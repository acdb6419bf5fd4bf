"""Estimates with 95 % confidence intervals, and the spread over retrainings that widens those of a single training.

A network is one draw of those that other random numbers would give: its interval over scenes (`bootstrap`) is widened
by the standard deviation over others that were trained on the same frames. Intervals of numbers in [0, 1] are on the
scale of log-odds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit, ndtri, stdtrit

CONFIDENCE = 0.95
TAILS = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)
EDGE = 1e-6  # shares are limited to this distance from 0 and 1 before their log-odds are taken


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


def average_estimates(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean of independent estimates; half-widths add in quadrature. It has no interval if one has none."""
    n = len(estimates)
    mean = float(np.mean([estimate.mean for estimate in estimates]))
    below = [estimate.mean - estimate.low for estimate in estimates if estimate.low is not None]
    above = [estimate.high - estimate.mean for estimate in estimates if estimate.high is not None]
    if min(len(below), len(above)) < n:
        return Estimate(mean, None, None)
    return Estimate(mean, mean - float(np.linalg.norm(below)) / n, mean + float(np.linalg.norm(above)) / n)


def score_interval(share: float, trials: int) -> Estimate:
    """Return a share of independent trials with Wilson's 95 % score interval (JASA 22, 1927), also of 0 and 1."""
    z2 = float(ndtri(TAILS[1])) ** 2 / trials
    middle = (share + z2 / 2) / (1 + z2)
    half = float(np.sqrt(z2 * share * (1 - share) + z2**2 / 4)) / (1 + z2)
    return Estimate(share, middle - half, middle + half)


@dataclass(frozen=True)
class Spread:
    """The standard deviation of a number over trainings on the same frames with other random numbers."""

    sd: float
    trainings: int  # number of trainings that the standard deviation was estimated from, at least 2

    @property
    def half_width(self) -> float:
        """Half the width of the 95 % interval for the mean over trainings, about one training: t(n - 1) · sd."""
        return float(stdtrit(self.trainings - 1, TAILS[1])) * self.sd


def measure_spread(values: Sequence[float]) -> Spread | None:
    """Return the spread of the trainings' `values`; None for fewer than two."""
    return Spread(float(np.std(values, ddof=1)), len(values)) if len(values) > 1 else None


def pool_spreads(spreads: Sequence[Spread]) -> Spread:
    """Return the pooled spread over several sets of frames: variances are averaged, weighted by degrees of freedom."""
    freedom = [spread.trainings - 1 for spread in spreads]
    variance = np.average([spread.sd**2 for spread in spreads], weights=freedom)
    return Spread(float(np.sqrt(variance)), sum(freedom) + 1)


def combine_spreads(first: Spread | None, second: Spread | None) -> Spread | None:
    """Return the spread of the difference of two numbers whose trainings vary independently; None where one is unknown.

    Variances add; `trainings` is the smaller of both.
    """
    if first is None or second is None:
        return None
    return Spread(float(np.hypot(first.sd, second.sd)), min(first.trainings, second.trainings))


def widen(estimate: Estimate, spread: Spread) -> Estimate:
    """Return an estimate of one training with the interval for the mean over trainings.

    Scenes and training vary independently, so that on either side the half-widths add in quadrature:
    sqrt(scenes^2 + (t · sd)^2). An estimate without an interval stays as it is.
    """
    if estimate.low is None or estimate.high is None:
        return estimate
    below = estimate.mean - estimate.low
    above = estimate.high - estimate.mean
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
