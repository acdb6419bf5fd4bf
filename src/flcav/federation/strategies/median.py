"""Coordinate-wise median of the clients' weights (Yin et al., ICML 2018, option I)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.federation.trainable import Update, Weights


def combine_coordinates(
    updates: Sequence[Update], combined: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> dict[str, NDArray[np.number]]:
    """Return `combined` of each floating array of all clients, stacked (clients, ...); of any other the first's."""
    return {
        name: combined(np.stack([update.weights[name].astype(np.float64) for update in updates])).astype(array.dtype)
        if np.issubdtype(array.dtype, np.floating)
        else array
        for name, array in updates[0].weights.items()
    }


@dataclass(frozen=True)
class Median:
    """Coordinate-wise median: withstands arbitrary updates of fewer than half of the clients. Samples do not count."""

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the median of the updates' weights, coordinate by coordinate."""
        return combine_coordinates(updates, lambda stacked: np.median(stacked, axis=0))

    def check_clients(self, clients: int) -> None:
        """Accept any number of clients: the median of two is their mean."""
