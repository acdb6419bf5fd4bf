"""Means over seeds, with Student's t intervals and tests over seeds and scenes; and the test of a single training.

Seeds differ in training and, where each has separate test scenes, in scenes. Of nested data only the top level is to be
resampled, since the values of seeds already vary by their scenes (Davison and Hinkley, "Bootstrap Methods and their
Application", 1997, section 3.8). For few seeds the bootstrap of the mean, with its standard error scaled by
sqrt(n / (n - 1)), is Student's t. Scenes that seeds share do not average out over seeds: their variance is the
covariance between seeds over draws of these scenes (`bootstrap.share_scenes`), and is added. Intervals of numbers in
[0, 1] are on the scale of log-odds. `tests/unit/statistics/test_seeds_and_scenes.py` simulates the coverage of this and
of other methods.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import expit, logit, ndtri, stdtr, stdtrit

from flcav.statistics.estimates import CONFIDENCE, EDGE, TAILS, Estimate, Spread, widen

LEVEL = 1 - CONFIDENCE  # significance level of a test, two-sided
LEAST_P = 1e-12  # smaller p-values are returned as 0
LARGEST_SPREAD = 0.1  # assumed where it is not known: above the deviation over retrainings of any in `reproductions`
FEWEST_SCENES = 6  # least number whose signs alone can be significant at `LEVEL`: 2^(1 - 6) = 0.03


@dataclass(frozen=True)
class SharedScenes:
    """The part of the spread of a mean over seeds that more seeds do not reduce, since they share test scenes."""

    sd: float = 0.0  # standard deviation of the mean over draws of these scenes
    scenes: int = 0  # number of scenes that several seeds share


OWN_SCENES = SharedScenes()  # no scenes are shared


def average_shared(parts: Sequence[SharedScenes]) -> SharedScenes:
    """Return the part of the spread of a mean over regions, whose scenes are independent, from those of the regions."""
    sd = float(np.linalg.norm([part.sd for part in parts])) / len(parts)
    return SharedScenes(sd, sum(part.scenes for part in parts))


@dataclass(frozen=True)
class MeanOverSeeds(Estimate):
    """The mean over seeds with its 95 % confidence interval, over seeds and scenes.

    There is no interval (None) of a single seed, nor of a share that is 0, or 1, in all seeds. The standard error is
    sqrt(sd^2 / n + shared.sd^2); its degrees of freedom are the harmonic mean of those of the seeds, n - 1, and of the
    shared scenes, weighted by their parts of the variance.
    """

    seeds: int = 1
    sd: float = 0.0  # standard deviation over seeds; 0 of a single seed
    shared: SharedScenes = OWN_SCENES
    share: bool = False  # whether it is a number in [0, 1], with interval and tests on the scale of log-odds

    @property
    def known(self) -> bool:
        """Return whether the spread over seeds is known, so that there are intervals and tests."""
        return self.seeds > 1 and (0 < self.mean < 1 or not self.share)

    def as_estimate(self) -> Estimate:
        """Return the mean and its interval alone."""
        return Estimate(self.mean, self.low, self.high)

    @property
    def slope(self) -> float:
        """Return the derivative of the tests' scale at the mean: of the log-odds for a share, 1 for other numbers."""
        return 1 / (self.mean * (1 - self.mean)) if self.share else 1.0

    def distance(self, hypothesis: float) -> float:
        """Return the difference of the mean from `hypothesis` on the tests' scale."""
        if not self.share:
            return self.mean - hypothesis
        return float(logit(self.mean) - logit(np.clip(hypothesis, EDGE, 1 - EDGE)))

    def p_value(self, hypothesis: float = 0.0) -> float | None:
        """Return the two-sided p-value of Student's t test that the mean is `hypothesis`; None without an interval."""
        if not self.known:
            return None
        error, freedom = standard_error(self.sd, self.seeds, self.shared)
        distance = abs(self.distance(hypothesis))
        if error == 0:
            return 0.0 if distance else 1.0
        return float(2 * stdtr(freedom, -distance / (self.slope * error)))

    def ends(self, level: float = LEVEL) -> tuple[float, float]:
        """Return the ends of the interval of a two-sided test at `level`, where the spread is known."""
        error, freedom = standard_error(self.sd, self.seeds, self.shared)
        half = float(stdtrit(freedom, 1 - level / 2)) * error
        if not self.share:
            return self.mean - half, self.mean + half
        low, high = expit(logit(self.mean) + self.slope * half * np.array([-1, 1])).tolist()
        return low, high


@dataclass(frozen=True)
class OneTraining(MeanOverSeeds):
    """A number of one training whose standard deviation over trainings on the same frames is known from others.

    `shared` is the part by test scenes, of the half-width towards 0. Interval and p-value are those of `widen`.
    """

    trainings: int = 2  # number of trainings that the standard deviation was estimated from

    @property
    def known(self) -> bool:
        """Return True: there is always a test."""
        return True

    def ends(self, level: float = LEVEL) -> tuple[float, float]:
        """Return the ends of the interval of `widen` at `level`; the scenes' half-widths scale as normal quantiles."""
        assert self.low is not None
        assert self.high is not None
        scale = float(ndtri(1 - level / 2) / ndtri(TAILS[1]))
        of_trainings = Spread(self.sd, self.trainings).half_width
        half = float(stdtrit(self.trainings - 1, 1 - level / 2)) * self.sd
        sides = np.array([self.mean - self.low, self.high - self.mean])
        # `widen` added the half-widths in quadrature: the part of the scenes remains when that of trainings is removed.
        below, above = np.hypot(scale * np.sqrt(np.maximum(sides**2 - of_trainings**2, 0.0)), half).tolist()
        return self.mean - below, self.mean + above

    def p_value(self, hypothesis: float = 0.0) -> float:
        """Return the level at which the interval of `widen` ends at `hypothesis`."""
        distance = abs(self.distance(hypothesis))
        of_scenes = self.shared.sd

        def beyond(p: float) -> float:
            scenes = ndtri(1 - p / 2) * of_scenes
            trainings = stdtrit(self.trainings - 1, 1 - p / 2) * self.sd
            return float(np.hypot(scenes, trainings)) - distance

        if distance == 0:
            return 1.0
        return 0.0 if beyond(LEAST_P) < 0 else float(root_scalar(beyond, bracket=(LEAST_P, 1.0)).root)


def of_one_training(over_scenes: Estimate, scenes: int, spread: Spread) -> OneTraining | None:
    """Return a number of one training with the interval of `widen`; None where there is no interval over its scenes."""
    mean, low, high = over_scenes.mean, over_scenes.low, over_scenes.high
    if low is None or high is None:
        return None
    wide = widen(over_scenes, spread)
    half = mean - low if mean > 0 else high - mean
    shared = SharedScenes(half / float(ndtri(TAILS[1])), scenes)
    return OneTraining(mean, wide.low, wide.high, 1, spread.sd, shared, trainings=spread.trainings)


def p_value_of_loss(over_scenes: Estimate, scenes: int, spread: float = LARGEST_SPREAD) -> float | None:
    """Return the two-sided p-value of a negative difference of one training whose spread over retrainings is not known.

    `spread`: the standard deviation that is assumed instead. The interval over scenes, of normal quantiles and of a
    standard deviation that divides by the number of scenes, is widened for few scenes by Student's t, with degrees of
    freedom as in `standard_error`. None for a difference that is not negative, without an interval, or of fewer than
    `FEWEST_SCENES` scenes, which might all be affected by a rare failure.
    """
    mean, high = over_scenes.mean, over_scenes.high
    if high is None or mean >= 0 or scenes < FEWEST_SCENES:
        return None
    of_scenes = (high - mean) / float(ndtri(TAILS[1])) * float(np.sqrt(scenes / (scenes - 1)))
    error = float(np.hypot(of_scenes, spread))
    freedom = (scenes - 1) * (error / of_scenes) ** 2 if of_scenes > 0 else np.inf
    return float(2 * stdtr(freedom, mean / error))


def mean_over_seeds(
    values: Sequence[float], *, shared: SharedScenes = OWN_SCENES, share: bool = False
) -> MeanOverSeeds:
    """Return the mean of `values`, one per seed, and its 95 % interval: mean ± t · sqrt(sd^2 / n + shared.sd^2).

    `share`: a number in [0, 1], whose interval is on the scale of log-odds by the delta method and stays inside [0, 1].
    """
    array = np.asarray(values, dtype=np.float64)
    sd = float(array.std(ddof=1)) if len(array) > 1 else 0.0
    over_seeds = MeanOverSeeds(float(array.mean()), None, None, len(array), sd, shared, share)
    low, high = over_seeds.ends() if over_seeds.known else (None, None)
    return replace(over_seeds, low=low, high=high)


def standard_error(sd: float, seeds: int, shared: SharedScenes) -> tuple[float, float]:
    """Return the standard error of a mean over seeds, and its degrees of freedom."""
    independent = sd**2 / seeds
    common = shared.sd**2
    if independent + common == 0:
        return 0.0, seeds - 1
    freedom = (independent + common) / (independent / (seeds - 1) + common / max(shared.scenes - 1, 1))
    return float(np.sqrt(independent + common)), freedom


def half_width(sd: float, seeds: int) -> float:
    """Return half the width of the 95 % interval of a mean over at least two seeds of standard deviation `sd`."""
    return float(stdtrit(seeds - 1, TAILS[1])) * sd / float(np.sqrt(seeds))
