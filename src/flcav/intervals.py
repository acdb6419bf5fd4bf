"""95 % confidence intervals: the percentile bootstrap over scenes, Student's t over seeds, and the power of a t test.

Frames of one scene share their traffic, so the bootstrap resamples whole scenes (Efron and Tibshirani, "An Introduction
to the Bootstrap", 1993, ch. 13: percentile intervals). A single training adds the spread of retraining: its network is
one draw of those that other random numbers would give.

Seeds differ in training and, where each has test scenes of its own, in scenes. Of nested data only the top level is to
be resampled, since the values of seeds vary by their scenes already (Davison and Hinkley, "Bootstrap Methods and their
Application", 1997, section 3.8). For few seeds the bootstrap of the mean, with its standard error scaled by
sqrt(n / (n - 1)), is Student's t. Scenes that seeds share do not average out over seeds: their variance is the
covariance between seeds over draws of these scenes, and is added. Numbers in [0, 1] have their interval on the scale
of log-odds.
`tests/unit/test_seeds_and_scenes.py` simulates the coverage of this and of other methods.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import root_scalar
from scipy.special import expit, logit, nctdtr, ndtri, stdtr, stdtrit

CONFIDENCE = 0.95
REDRAWS = 1000
TAILS = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)
EDGE = 1e-6  # log-odds are taken of shares this far from 0 and 1
LEVEL = 1 - CONFIDENCE  # of a test, two-sided
LEAST_P = 1e-12  # p-values below are 0
POWER = 0.8  # chance to tell an effect that a number of seeds is planned for
MOST_SEEDS = 1000  # that a plan of seeds is sought up to


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
    """Return the mean of independent estimates; half-widths add in quadrature. One without an interval gives none."""
    n, mean = len(estimates), float(np.mean([each.mean for each in estimates]))
    below = [each.mean - each.low for each in estimates if each.low is not None]
    above = [each.high - each.mean for each in estimates if each.high is not None]
    if min(len(below), len(above)) < n:
        return Estimate(mean, None, None)
    return Estimate(mean, mean - float(np.linalg.norm(below)) / n, mean + float(np.linalg.norm(above)) / n)


@dataclass(frozen=True)
class SharedScenes:
    """The part of the spread of a mean over seeds that more seeds do not reduce, since they share test scenes."""

    sd: float = 0.0  # standard deviation of the mean over draws of these scenes
    scenes: int = 0  # that several seeds share


OWN_SCENES = SharedScenes()  # every seed has test scenes of its own


@dataclass(frozen=True)
class MeanOverSeeds(Estimate):
    """The mean over seeds with its 95 % confidence interval, over seeds and scenes.

    There is no interval (None) of a single seed, and none of a share that is 0, or 1, in all seeds. The standard error
    is sqrt(sd^2 / n + shared.sd^2); its degrees of freedom are the harmonic mean of those of the seeds, n - 1, and of
    the shared scenes, weighted by their parts of the variance.
    """

    seeds: int = 1
    sd: float = 0.0  # standard deviation over seeds; 0 of a single seed
    shared: SharedScenes = OWN_SCENES
    share: bool = False  # a number in [0, 1]: its interval and tests are on the scale of log-odds

    @property
    def known(self) -> bool:
        """Return whether the spread over seeds is known, so that there are intervals and tests."""
        return self.seeds > 1 and (0 < self.mean < 1 or not self.share)

    def as_estimate(self) -> Estimate:
        """Return the mean and its interval alone."""
        return Estimate(self.mean, self.low, self.high)

    @property
    def slope(self) -> float:
        """Return the derivative of the tests' scale: that of the log-odds for a share, 1 for other numbers."""
        return 1 / (self.mean * (1 - self.mean)) if self.share else 1.0

    def distance(self, hypothesis: float) -> float:
        """Return how far the mean is above `hypothesis`, on the tests' scale."""
        if not self.share:
            return self.mean - hypothesis
        return float(logit(self.mean) - logit(np.clip(hypothesis, EDGE, 1 - EDGE)))

    def p_value(self, hypothesis: float = 0.0) -> float | None:
        """Return the two-sided p-value of Student's t test that the mean is `hypothesis`; None without an interval."""
        if not self.known:
            return None
        error, freedom = _standard_error(self.sd, self.seeds, self.shared)
        far = abs(self.distance(hypothesis))
        if error == 0:
            return 0.0 if far else 1.0
        return float(2 * stdtr(freedom, -far / (self.slope * error)))

    def ends(self, level: float = LEVEL) -> tuple[float, float]:
        """Return the ends of the interval of a two-sided test at `level`, where the spread is known."""
        error, freedom = _standard_error(self.sd, self.seeds, self.shared)
        half = float(stdtrit(freedom, 1 - level / 2)) * error
        if not self.share:
            return self.mean - half, self.mean + half
        low, high = expit(logit(self.mean) + self.slope * half * np.array([-1, 1])).tolist()
        return low, high

    def seeds_to_tell(self, hypothesis: float = 0.0, level: float = LEVEL) -> int | None:
        """Return `plan_seeds` for an effect as large as the distance from `hypothesis`, if the spread is known."""
        if not self.known:
            return None
        shared = SharedScenes(self.slope * self.shared.sd, self.shared.scenes)
        return plan_seeds(self.distance(hypothesis), self.slope * self.sd, level, shared)


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


def pool_spreads(spreads: Sequence[Spread]) -> Spread:
    """Return the spread over several sets of frames: variances are averaged, weighted by their degrees of freedom."""
    freedom = [each.trainings - 1 for each in spreads]
    variance = np.average([each.sd**2 for each in spreads], weights=freedom)
    return Spread(float(np.sqrt(variance)), sum(freedom) + 1)


def combine_spreads(first: Spread | None, second: Spread | None) -> Spread | None:
    """Return the spread of the difference of two numbers whose trainings vary independently; None where one is unknown.

    Variances add; trainings are the fewer of both.
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
    below, above = estimate.mean - estimate.low, estimate.high - estimate.mean
    half = spread.half_width
    return Estimate(estimate.mean, estimate.mean - np.hypot(below, half), estimate.mean + np.hypot(above, half))


@dataclass(frozen=True)
class OneTraining(MeanOverSeeds):
    """A number of one training whose standard deviation over trainings on the same frames is known from others.

    `shared` is that of the test scenes, towards 0. Interval and p-value are those of `widen`.
    """

    trainings: int = 2  # that the standard deviation was estimated from

    @property
    def known(self) -> bool:
        """Return that there is a test."""
        return True

    def ends(self, level: float = LEVEL) -> tuple[float, float]:
        """Return the ends of the interval of `widen` at `level`; half-widths over scenes are as normal quantiles."""
        assert self.low is not None
        assert self.high is not None
        grown = float(ndtri(1 - level / 2) / ndtri(TAILS[1]))
        own = Spread(self.sd, self.trainings).half_width
        half = float(stdtrit(self.trainings - 1, 1 - level / 2)) * self.sd
        sides = np.array([self.mean - self.low, self.high - self.mean])
        below, above = np.hypot(grown * np.sqrt(np.maximum(sides**2 - own**2, 0.0)), half).tolist()
        return self.mean - below, self.mean + above

    def p_value(self, hypothesis: float = 0.0) -> float:
        """Return the level at which the interval of `widen` ends at `hypothesis`."""
        far, of_scenes = abs(self.distance(hypothesis)), self.shared.sd

        def beyond(p: float) -> float:
            scenes, trainings = ndtri(1 - p / 2) * of_scenes, stdtrit(self.trainings - 1, 1 - p / 2) * self.sd
            return float(np.hypot(scenes, trainings)) - far

        if far == 0:
            return 1.0
        return 0.0 if beyond(LEAST_P) < 0 else float(root_scalar(beyond, bracket=(LEAST_P, 1.0)).root)


def of_one_training(over_scenes: Estimate, scenes: int, spread: Spread) -> OneTraining | None:
    """Return a number of one training with the interval of `widen`; None where there is none over its scenes."""
    mean, low, high = over_scenes.mean, over_scenes.low, over_scenes.high
    if low is None or high is None:
        return None
    wide = widen(over_scenes, spread)
    half = mean - low if mean > 0 else high - mean
    shared = SharedScenes(half / float(ndtri(TAILS[1])), scenes)
    return OneTraining(mean, wide.low, wide.high, 1, spread.sd, shared, trainings=spread.trainings)


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


def share_scenes(
    measures: Sequence[Callable[[NDArray[np.int64]], NDArray[np.float64]]],
    scenes_of_frames: Sequence[ArrayLike],
    n: int = REDRAWS,
    *,
    rng: np.random.Generator,
) -> SharedScenes:
    """Return the spread of the mean over seeds by the test scenes that several seeds share.

    `measures` and `scenes_of_frames` are those of `bootstrap_over_scenes`, one per seed. A scene's weight is drawn from
    a Poisson distribution of mean 1, the same in all seeds that have it (Poisson bootstrap; Hanley and MacGibbon,
    Computer Methods and Programs in Biomedicine 83, 2006). The variance is the mean covariance between two seeds, at
    least 0.
    """
    scenes = [np.asarray(each) for each in scenes_of_frames]
    names, counts = np.unique(np.concatenate([np.unique(each) for each in scenes]), return_counts=True)
    shared = int((counts > 1).sum())
    if not shared:
        return OWN_SCENES
    times = rng.poisson(1.0, size=(n, len(names)))
    draws = np.array([of(times[:, np.searchsorted(names, each)]) for of, each in zip(measures, scenes, strict=True)])
    covariance = np.cov(draws[:, np.isfinite(draws).all(axis=0)])
    between = covariance[~np.eye(len(draws), dtype=bool)].mean()
    return SharedScenes(float(np.sqrt(max(between, 0.0))), shared)


def score_interval(share: float, trials: int) -> Estimate:
    """Return a share of independent trials with Wilson's 95 % score interval (JASA 22, 1927), of 0 and 1, too."""
    z2 = float(ndtri(TAILS[1])) ** 2 / trials
    middle = (share + z2 / 2) / (1 + z2)
    half = float(np.sqrt(z2 * share * (1 - share) + z2**2 / 4)) / (1 + z2)
    return Estimate(share, middle - half, middle + half)


def mean_over_seeds(
    values: Sequence[float], *, shared: SharedScenes = OWN_SCENES, share: bool = False
) -> MeanOverSeeds:
    """Return the mean of `values`, one per seed, and its 95 % interval: mean ± t · sqrt(sd^2 / n + shared.sd^2).

    `share`: a number in [0, 1], whose interval is on the scale of log-odds by the delta method and stays inside [0, 1].
    """
    array = np.asarray(values, dtype=np.float64)
    sd = float(array.std(ddof=1)) if len(array) > 1 else 0.0
    found = MeanOverSeeds(float(array.mean()), None, None, len(array), sd, shared, share)
    low, high = found.ends() if found.known else (None, None)
    return replace(found, low=low, high=high)


def _standard_error(sd: float, seeds: int, shared: SharedScenes) -> tuple[float, float]:
    """Return the standard error of a mean over seeds, and its degrees of freedom."""
    own, common = sd**2 / seeds, shared.sd**2
    if own + common == 0:
        return 0.0, seeds - 1
    freedom = (own + common) / (own / (seeds - 1) + common / max(shared.scenes - 1, 1))
    return float(np.sqrt(own + common)), freedom


def power_of_seeds(
    effect: float, sd: float, seeds: int, level: float = LEVEL, shared: SharedScenes = OWN_SCENES
) -> float:
    """Return the power of the two-sided t test of a mean of `effect` over seeds of standard deviation `sd`.

    It is that of the noncentral t distribution (Cohen, "Statistical Power Analysis for the Behavioral Sciences", 1988).
    """
    error, freedom = _standard_error(sd, seeds, shared)
    if error == 0:
        return float(effect != 0)
    beyond, limit = abs(effect) / error, stdtrit(freedom, 1 - level / 2)
    missed, wrong_side = np.nan_to_num(nctdtr(freedom, beyond, [limit, -limit]))  # not a number where next to 0
    return float(1 - missed + wrong_side)


def plan_seeds(
    effect: float, sd: float, level: float = LEVEL, shared: SharedScenes = OWN_SCENES, power: float = POWER
) -> int | None:
    """Return the least number of seeds that tell `effect` with the given power; None for more than `MOST_SEEDS`.

    `sd` is the standard deviation over seeds of the effect: of differences, that of the paired differences.
    """
    least, most = 1, MOST_SEEDS
    if power_of_seeds(effect, sd, most, level, shared) < power:
        return None
    while most - least > 1:  # power rises with seeds
        middle = (least + most) // 2
        enough = power_of_seeds(effect, sd, middle, level, shared) >= power
        least, most = (least, middle) if enough else (middle, most)
    return most


def half_width(sd: float, seeds: int) -> float:
    """Return half the width of the 95 % interval of a mean over at least two seeds of standard deviation `sd`."""
    return float(stdtrit(seeds - 1, TAILS[1])) * sd / float(np.sqrt(seeds))
