"""Learning curves against runs that they were not fitted to: each run of a history is predicted from the others.

What no curve can foresee is how a run's training turned out. `noise_of_runs` splits the residuals of a history into
the differences between runs and the scatter within them, a random effect of the run (one-way analysis of variance by
the method of moments, Searle, Casella and McCulloch, "Variance Components", 1992, sec. 3.6), and the rank correlation
that a true curve would reach with as much noise says how far a prediction can get.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata

from flcav.config import InputError
from flcav.optimization.curves.fitting import CurveFit
from flcav.optimization.curves.history import Array, History
from flcav.seeds import stream

SIMULATED = 400  # histories drawn for the attainable rank correlation


@dataclass(frozen=True)
class HeldOut:
    """Agreement of predicted and realised accuracy over all points of runs held out."""

    runs: int
    points: int
    mean_error: float  # mean absolute difference
    rank_correlation: float  # Spearman's
    between_runs: float  # standard deviation of a run's deviation from the curve of all runs
    within_runs: float  # standard deviation of a point about its run's
    attainable: float  # mean rank correlation of that curve with itself under such noise


def hold_out_runs(history: History, fit: Callable[[History], CurveFit], k: int = 1) -> HeldOut:
    """Return how well curves fitted by `fit` to all runs but one predict that one; `k`: edge rounds per cloud round.

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
        curve = fit(history.select(~held)).curve
        predicted[held] = 1 - curve.error(*history.resources[held].T, k=k)
    expected = 1 - fit(history).curve.error(*history.resources.T, k=k)
    between, within = noise_of_runs(history.accuracy - expected, names)
    return HeldOut(
        len(runs),
        len(names),
        float(np.abs(predicted - history.accuracy).mean()),
        rank_correlation(predicted, history.accuracy),
        between,
        within,
        attainable_correlation(expected, names, between, within),
    )


def rank_correlation(one: ArrayLike, other: ArrayLike) -> float:
    """Return Spearman's rank correlation of two samples (n,), ties at mean ranks; 0 where one is constant."""
    if not (np.ptp(one) and np.ptp(other)):
        return 0.0
    return float(np.corrcoef(rankdata(one), rankdata(other))[0, 1])


def noise_of_runs(residual: Array, runs: NDArray[np.str_]) -> tuple[float, float]:
    """Return the standard deviations between and within runs of residuals (n,), each of the run in `runs` (n,).

    That between runs is 0 where their means differ by less than the scatter within them explains; that within them is 0
    where each has one point.
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
