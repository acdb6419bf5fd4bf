"""Coordinate-wise median of the clients' weights (Yin et al., ICML 2018, option I)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.federation.strategies.fedavg import round_mean
from flcav.federation.strategies.mixing import Mixing, check_mixing, mix_neighbours
from flcav.federation.trainable import Update, Weights


def combine_coordinates(
    models: Sequence[Weights], combined: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> dict[str, NDArray[np.number]]:
    """Return `combined` of each array of all clients, stacked (clients, ...); of integers rounded, see `round_mean`."""
    found: dict[str, NDArray[np.number]] = {}
    for name, array in models[0].items():
        stacked = np.stack([own[name] for own in models])
        values = np.asarray(combined(stacked.astype(np.float64)))
        floating = np.issubdtype(array.dtype, np.floating)
        found[name] = (
            values.astype(array.dtype) if floating else round_mean(values, stacked.min(axis=0), stacked.max(axis=0))
        )
    return found


def take_median(models: Sequence[Weights]) -> dict[str, NDArray[np.number]]:
    """Return the coordinate-wise median of all clients' arrays."""
    return combine_coordinates(models, lambda stacked: np.median(stacked, axis=0))


@dataclass(frozen=True)
class Median:
    """Coordinate-wise median: withstands arbitrary updates of fewer than half of the clients. Samples do not count."""

    mixing: Mixing = 0  # see `mix_neighbours`

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the median of the updates' weights, coordinate by coordinate."""
        return take_median([update.weights for update in mix_neighbours(updates, self.mixing)])

    def check_clients(self, clients: int) -> None:
        """Raise as `check_mixing` does; otherwise accept any number of clients: the median of two is their mean."""
        check_mixing(self.mixing, clients)
