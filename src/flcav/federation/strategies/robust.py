"""Byzantine-robust aggregation: median, trimmed mean, Krum, each optionally after nearest-neighbour mixing.

Median and trimmed mean are coordinate-wise (Yin et al., ICML 2018, options I and II). Krum keeps the updates that are
nearest to others (Blanchard et al., NeurIPS 2017, section 4). Its distances are those of learned arrays; statistics of
batch normalisation have another scale and are the median of all updates, so that no single client chooses them. Where
the clients' data are heterogeneous, honest updates lie far apart, and a rule that keeps few of them is easily misled.
Nearest-neighbour mixing (Allouah et al., "Fixing by Mixing", AISTATS 2023, algorithm 2) therefore first replaces every
update x_i by y_i, the mean of the n - f updates nearest to x_i, including x_i, where f of n are Byzantine. Only learned
arrays are mixed.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import InputError
from flcav.federation.strategies.fedavg import average, round_mean
from flcav.federation.trainable import LocalUpdate, Update, Weights, learned_names

Mixing = Annotated[int, Field(ge=0, le=10**6)]  # Byzantine clients that mixing withstands; 0: no mixing


def mix_neighbours(updates: Sequence[Update], mixing: Mixing) -> Sequence[Update]:
    """Return the updates after nearest-neighbour mixing: means over the n - `mixing` nearest; unchanged for 0.

    Ties go to the first updates. Numbers of samples are not used.
    """
    if not mixing:
        return updates
    names = learned_names(updates[0].weights)
    flat = flatten_updates(updates, names)
    mixed = []
    for row, update in zip(flat, updates, strict=True):
        near = np.argsort(((flat - row) ** 2).sum(axis=1), kind="stable")[: len(updates) - mixing]
        mean = flat[np.sort(near)].mean(axis=0)
        start = 0
        weights = dict(update.weights)
        for name in names:
            array = update.weights[name]
            weights[name] = mean[start : start + array.size].reshape(array.shape).astype(array.dtype)
            start += array.size
        mixed.append(LocalUpdate(weights, update.samples, update.loss))
    return mixed


def check_mixing(mixing: Mixing, clients: int) -> None:
    """Raise `InputError` unless the Byzantine clients are fewer than half of all."""
    if mixing and clients <= 2 * mixing:
        raise InputError(f"mixing: {2 * mixing + 1} clients or more are wanted for {mixing}, and there are {clients}")


def flatten_updates(updates: Sequence[Update], names: Sequence[str]) -> NDArray[np.float64]:
    """Return the arrays `names` of the updates as rows (updates, coordinates)."""
    return np.stack(
        [np.concatenate([update.weights[name].astype(np.float64).ravel() for name in names]) for update in updates]
    )


def combine_coordinates(
    models: Sequence[Weights], combined: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> dict[str, NDArray[np.number]]:
    """Return `combined` of the stacked arrays (clients, ...), name by name; integers are rounded, see `round_mean`."""
    found: dict[str, NDArray[np.number]] = {}
    for name, array in models[0].items():
        stacked = np.stack([model[name] for model in models])
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
        """Raise as `check_mixing` does; otherwise any number of clients is fine: the median of two is their mean."""
        check_mixing(self.mixing, clients)


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
        """Raise `InputError` where the fraction is less than one client, and as `check_mixing` does."""
        check_mixing(self.mixing, clients)
        if self.fraction and self._count_out(clients) == 0:
            raise InputError(f"trimmed-mean: a fraction of {self.fraction:g} of {clients} clients leaves nobody out")

    def _count_out(self, clients: int) -> int:
        """Return the number left out at either end; .29 of 100 clients is 29, although .29 * 100 is 28.999..."""
        return math.floor(round(self.fraction * clients, 9))


@dataclass(frozen=True)
class Krum:
    """Krum: of n updates the one with the least sum of squared distances to its n - byzantine - 2 nearest others.

    With `kept` above 1 it is multi-Krum: the mean of the `kept` updates with the least sums. Samples do not count.
    Arrays that are not learned are the coordinate-wise median of all updates.
    """

    byzantine: Annotated[int, Field(ge=0, le=10**6)] = 1  # clients that it is to withstand
    kept: Annotated[int, Field(ge=1, le=10**6)] = 1
    mixing: Mixing = 0  # see `mix_neighbours`

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the learned arrays of the chosen update, or the mean of several, and the median of all other arrays.

        Raises as `check_clients` does.
        """
        self.check_clients(len(updates))
        names = learned_names(start)
        mixed = mix_neighbours(updates, self.mixing)
        flat = flatten_updates(mixed, names)
        # the smallest distance of a row is that to itself, 0, and is left out
        near = len(updates) - self.byzantine - 2
        scores = [np.sort(((flat - row) ** 2).sum(axis=1))[1 : near + 1].sum() for row in flat]
        chosen = [mixed[i] for i in np.sort(np.argsort(scores, kind="stable")[: self.kept])]
        mean = average([update.weights for update in chosen], [1.0] * len(chosen))
        rest = [name for name in start if name not in names]
        return {**mean, **take_median([{name: update.weights[name] for name in rest} for update in updates])}

    def check_clients(self, clients: int) -> None:
        """Raise `InputError` unless clients > 2 byzantine + 2, as the paper's theorem requires, and `kept` <= clients.

        Raises as `check_mixing` does, too.
        """
        check_mixing(self.mixing, clients)
        least = max(2 * self.byzantine + 3, self.kept)
        if clients < least:
            raise InputError(
                f"krum: {least} clients or more are wanted for byzantine = {self.byzantine} and kept = {self.kept}, "
                f"and there are {clients}"
            )
