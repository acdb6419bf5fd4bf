"""Levels of a history's seeds: random effects, which learning curves are fitted without.

Runs of one seed share traffic, training frames and validation frames; some frames are harder than others. The error of
a point is modelled as the curve's times a factor of its seed, as replanning scales a curve to the score that a run has
reached. The logarithms of the factors are the seed effects of a two-way analysis of variance of the log errors, with
the numbers of samples and rounds as the other classification, by weighted least squares (Searle, Casella and McCulloch,
"Variance Components", 1992, ch. 5); their weighted mean is 0, so that the levelled points are those of a mean seed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flcav.geometry.arrays import Array
from flcav.optimization.curves.history import History

LEAST_ERROR = 1e-4  # an error of 0 has no logarithm


@dataclass(frozen=True)
class Levelled:
    """A history with the levels of its seeds removed."""

    history: History  # points of a mean seed
    factors: Mapping[str, float]  # of the error, by seed; empty where the history has fewer than two seeds

    def of(self, seed: str) -> float:
        """Return the factor of a seed; 1 for one that is not known."""
        return self.factors.get(seed, 1.0)


def level_seeds(history: History) -> Levelled:
    """Return the points of a history as those of a mean seed, and the factor of each seed's errors.

    The factors follow from numbers of samples and rounds at which several seeds have points.
    """
    names, seed = np.unique(np.array(history.seeds), return_inverse=True)
    if len(names) < 2:
        return Levelled(history, {})
    effect = _seed_effects(history, seed, len(names))
    factor = np.exp(effect)
    error = np.clip((1 - history.accuracy) / factor[seed], 0, 1)
    return Levelled(replace(history, accuracy=1 - error), dict(zip(names.tolist(), factor.tolist(), strict=True)))


def _seed_effects(history: History, seed: NDArray[np.int64], count: int) -> Array:
    """Return the effect (S,) of each seed on the log error, of weighted mean 0, by the normal equations.

    The effects of the numbers of samples and rounds are eliminated: each class has its weighted mean subtracted.
    """
    _, point = np.unique(history.resources, axis=0, return_inverse=True)
    weight = history.weight
    error = np.log(np.maximum(1 - history.accuracy, LEAST_ERROR))
    columns = np.eye(count)[seed]  # (n, S)
    total = np.maximum(np.bincount(point, weight), np.finfo(float).tiny)

    def centre(values: Array) -> Array:
        mean = np.bincount(point, weight * values) / total
        return values - mean[point]

    centred = np.stack([centre(column) for column in columns.T], axis=1)
    root = np.sqrt(weight)
    effect = np.linalg.lstsq(centred * root[:, None], centre(error) * root, rcond=1e-9)[0]
    share = np.bincount(seed, weight, count)
    return effect - (effect * share).sum() / share.sum()
