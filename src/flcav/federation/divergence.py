"""Weight divergence of a federation's clients: relative L2 distance of their weights from the mean of these.

After Zhao et al., "Federated Learning with Non-IID Data", 2018, whose reference is centralised training.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.federation.trainable import Weights, learned_names, statistics_names
from flcav.storage.records import Record


@dataclass(frozen=True)
class Divergence(Record):
    """Weight divergence of several models: mean over them of |w_i - m| / |m|, where m is the mean of all w_i."""

    whole: float  # over all floating arrays
    statistics: float | None  # over batch normalisation's running means and variances; None: the network has none
    learned: float  # over all others, which gradients change


@dataclass(frozen=True)
class RoundDivergence(Record):
    """Weight divergence of the regions in a cloud round: of what they begin with, and of what the cloud averages."""

    begun: Divergence
    trained: Divergence


def measure_divergence(models: Sequence[Weights]) -> Divergence:
    """Return the weight divergence of models with arrays of the same names and shapes; 0 of a single one."""
    learned, statistics = learned_names(models[0]), statistics_names(models[0])
    return Divergence(
        whole=_mean_distance(models, [*learned, *statistics]),
        statistics=_mean_distance(models, statistics) if statistics else None,
        learned=_mean_distance(models, learned),
    )


def _mean_distance(models: Sequence[Weights], names: Sequence[str]) -> float:
    """Return the mean of |w_i - m| / |m| over the arrays `names`; where m is 0, of |w_i|."""
    rows = np.array([np.concatenate([np.ravel(own[name]).astype(np.float64) for name in names]) for own in models])
    mean = rows.mean(axis=0)
    return float(np.mean(np.linalg.norm(rows - mean, axis=1)) / (np.linalg.norm(mean) or 1.0))
