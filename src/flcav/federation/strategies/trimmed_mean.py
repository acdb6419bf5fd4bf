"""Coordinate-wise trimmed mean of the clients' weights (Yin et al., ICML 2018, option II)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import InputError
from flcav.federation.strategies.median import combine_coordinates
from flcav.federation.strategies.mixing import Mixing, check_mixing, mix_neighbours
from flcav.federation.trainable import Update, Weights


@dataclass(frozen=True)
class TrimmedMean:
    """Mean without the largest and the smallest values of each coordinate. Samples do not count."""

    fraction: Annotated[float, Field(ge=0, lt=0.5)] = 0.2  # of the clients that is left out at either end, rounded down
    mixing: Mixing = 0  # see `mix_neighbours`

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the trimmed mean of the updates' weights, coordinate by coordinate."""
        out = self._count_out(len(updates))

        def trimmed(stacked: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.sort(stacked, axis=0)[out : len(stacked) - out].mean(axis=0)

        return combine_coordinates([update.weights for update in mix_neighbours(updates, self.mixing)], trimmed)

    def check_clients(self, clients: int) -> None:
        """Raise `InputError` where the fraction of so few clients is less than one of them, and as `check_mixing`."""
        check_mixing(self.mixing, clients)
        if self.fraction and self._count_out(clients) == 0:
            raise InputError(f"trimmed-mean: a fraction of {self.fraction:g} of {clients} clients leaves nobody out")

    def _count_out(self, clients: int) -> int:
        """Return how many are left out at either end; of 100 clients .29 are 29, though .29 * 100 is 28.999..."""
        return math.floor(round(self.fraction * clients, 9))
