"""Learning curves against runs that they were not fitted to: each run of a history is predicted from the others."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from flcav.config import InputError
from flcav.optimization.curves.fitting import CurveFit
from flcav.optimization.curves.history import History


@dataclass(frozen=True)
class HeldOut:
    """Agreement of predicted and realised accuracy over all points of runs held out."""

    runs: int
    points: int
    mean_error: float  # mean absolute difference
    rank_correlation: float  # Spearman's


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
    agreement = np.corrcoef(rankdata(predicted), rankdata(history.accuracy))[0, 1]
    return HeldOut(len(runs), len(names), float(np.abs(predicted - history.accuracy).mean()), float(agreement))
