"""Learning curves on runs that they were not fitted to: every run of a history is predicted from the others.

No curve can foresee how the training of a run turned out. `noise_of_runs` splits the residuals of a history into the
differences between runs and the scatter within them, a random effect of the run (one-way analysis of variance by the
method of moments, Searle, Casella and McCulloch, "Variance Components", 1992, sec. 3.6); the rank correlation that a
true curve would reach under such noise is the limit of any prediction. The limit of the error at a point follows
without any curve from other seeds' points with the same numbers of samples and rounds (pure error; Draper and Smith,
"Applied Regression Analysis", 1998, sec. 2.1). The level of a run's seed is known from the other runs of the seed; that
of a seed held out as a whole is not, until its run has pretrained.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata

from flcav.config import InputError
from flcav.geometry.arrays import Array
from flcav.optimization.curves.curves import OwnCurve
from flcav.optimization.curves.fitting import CurveFit
from flcav.optimization.curves.history import History
from flcav.optimization.curves.levels import Levelled, level_seeds
from flcav.statistics.streams import stream

SIMULATED = 400  # histories drawn for the attainable rank correlation


@dataclass(frozen=True)
class HeldOut:
    """Agreement of predicted and realised accuracy over all points of held-out runs."""

    runs: int
    points: int
    mean_error: float  # mean absolute difference
    rank_correlation: float  # Spearman's
    between_runs: float  # standard deviation of a run's deviation from the curve of all runs
    within_runs: float  # standard deviation of a point about its run's
    attainable: float  # mean rank correlation of that curve with itself under such noise
    attainable_error: float | None  # mean error that the true curve would leave, by `measure_pure_error`
    new_seeds: "NewSeeds | None" = None  # None: the history has one seed


@dataclass(frozen=True)
class NewSeeds:
    """Agreement over all points after pretraining of seeds held out whole, before and after their runs pretrained."""

    points: int
    mean_error: float  # mean absolute difference, predicted before the run
    rank_correlation: float
    mean_error_pretrained: float  # of a curve that is scaled to the score after pretraining, as replanning does
    rank_correlation_pretrained: float


def hold_out_runs(history: History, fit: Callable[[History], CurveFit], k: int = 1) -> HeldOut:
    """Return how well curves fitted by `fit` to all runs but one predict that one; `k` is edge rounds per cloud round.

    `fit` returns the curve of a mean seed, see `level_seeds`; a run's curve is that times the factor of its seed.
    Raises `InputError` for a history of fewer than three runs, and as `fit` does.
    """
    names = np.array(history.runs)
    runs = np.unique(names)
    if len(runs) < 3:
        raise InputError(
            f"runs are held out one after another: 3 or more are wanted in the column 'run', not {len(runs)}"
        )
    predicted = np.empty(len(names))
    for run in runs:
        held = names == run
        others = history.select(~held)
        predicted[held] = _predict(fit(others).curve, level_seeds(others), history.select(held), k)
    expected = _predict(fit(history).curve, level_seeds(history), history, k)
    between, within = noise_of_runs(history.accuracy - expected, names)
    return HeldOut(
        len(runs),
        len(names),
        float(np.abs(predicted - history.accuracy).mean()),
        rank_correlation(predicted, history.accuracy),
        between,
        within,
        attainable_correlation(expected, names, between, within),
        measure_pure_error(history),
        _hold_out_seeds(history, fit, k),
    )


def measure_pure_error(history: History) -> float | None:
    """Return the mean absolute error that the true curve would leave, from points with the same resources; else None.

    A run's point is compared with the mean of m points of other seeds, at its seed's level. Such a mean has 1 / m of a
    point's variance, so that a curve without error would be off by sqrt(m / (m + 1)) of the difference. Points of seeds
    without another run, whose level is unknown, are left out.
    """
    if len(set(history.seeds)) < 2:
        return None
    names = np.array(history.runs)
    seeds = np.array(history.seeds)
    left: list[Array] = []
    for run in np.unique(names):
        held = names == run
        levelled = level_seeds(history.select(~held))
        others = levelled.history
        same = (history.resources[held][:, None] == others.resources[None]).all(axis=2)  # (points, others)
        same &= np.array(others.seeds) != seeds[held][:, None]
        count = same.sum(axis=1)
        usable = (count > 0) & np.isin(seeds[held], list(levelled.factors))
        mean = (same @ (1 - others.accuracy))[usable] / count[usable]
        factor = np.array([levelled.of(seed) for seed in seeds[held][usable]])
        off = np.abs(1 - factor * mean - history.accuracy[held][usable])
        left.append(off * np.sqrt(count[usable] / (count[usable] + 1)))
    differences = np.concatenate(left)
    return float(differences.mean()) if len(differences) else None


def _predict(curve: OwnCurve, levelled: Levelled, history: History, k: int) -> Array:
    """Return the accuracy (n,) that the curve of a mean seed, times the seeds' factors, predicts for a history."""
    factor = np.array([levelled.of(seed) for seed in history.seeds]) if history.seeds else 1.0
    return 1 - factor * curve.error(*history.resources.T, k=k)


def _hold_out_seeds(history: History, fit: Callable[[History], CurveFit], k: int) -> NewSeeds | None:
    """Return how well curves fitted to all seeds but one predict that one; None for a single seed."""
    seeds = np.array(history.seeds)
    names = np.array(history.runs)
    if len(np.unique(seeds)) < 2:
        return None
    pretrained = ~history.resources[:, 1:].any(axis=1)
    before, after = np.empty((2, len(names)))
    for seed in np.unique(seeds):
        held = seeds == seed
        curve = fit(history.select(~held)).curve
        before[held] = 1 - curve.error(*history.resources[held].T, k=k)
        for run in np.unique(names[held]):
            of_run = held & (names == run)
            reached = (1 - history.accuracy[of_run & pretrained]).mean() / (1 - before[of_run & pretrained]).mean()
            after[of_run] = 1 - reached * (1 - before[of_run])
    rest = ~pretrained
    realised = history.accuracy[rest]
    return NewSeeds(
        int(rest.sum()),
        float(np.abs(before[rest] - realised).mean()),
        rank_correlation(before[rest], realised),
        float(np.abs(after[rest] - realised).mean()),
        rank_correlation(after[rest], realised),
    )


def rank_correlation(one: ArrayLike, other: ArrayLike) -> float:
    """Return Spearman's rank correlation of two samples (n,), ties at mean ranks; 0 where one is constant."""
    if not (np.ptp(one) and np.ptp(other)):
        return 0.0
    return float(np.corrcoef(rankdata(one), rankdata(other))[0, 1])


def noise_of_runs(residual: Array, runs: NDArray[np.str_]) -> tuple[float, float]:
    """Return the standard deviations between and within runs of residuals (n,), whose runs are named in `runs` (n,).

    The former is 0 where the runs' means differ by less than the scatter within them explains; the latter is 0 where
    every run has one point.
    """
    names, run, count = np.unique(runs, return_inverse=True, return_counts=True)
    means = np.bincount(run, residual) / count
    free = len(residual) - len(names)
    within = float(((residual - means[run]) ** 2).sum() / free) if free else 0.0
    spread = float((count * (means - residual.mean()) ** 2).sum() / (len(names) - 1))
    size = (len(residual) - (count**2).sum() / len(residual)) / (len(names) - 1)
    return float(np.sqrt(max(spread - within, 0) / size)), float(np.sqrt(within))


def attainable_correlation(expected: Array, runs: NDArray[np.str_], between: float, within: float) -> float:
    """Return the mean rank correlation of `expected` (n,) with itself plus drawn noise between and within `runs`."""
    drawn = stream(0, "attainable")
    _, run = np.unique(runs, return_inverse=True)
    noise = drawn.normal(0, between, (SIMULATED, run.max() + 1))[:, run]
    noise += drawn.normal(0, within, (SIMULATED, len(run)))
    return float(np.mean([rank_correlation(expected, expected + each) for each in noise]))
