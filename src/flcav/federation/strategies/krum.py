"""Krum and multi-Krum: the updates nearest to their neighbours (Blanchard et al., NeurIPS 2017, section 4).

Distances are of what is learned. Statistics of batch normalisation, of another scale, are the median of all updates, so
that they are nobody's choice.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from flcav.config import InputError
from flcav.federation.strategies.fedavg import average
from flcav.federation.strategies.median import take_median
from flcav.federation.strategies.mixing import Mixing, check_mixing, flatten_updates, mix_neighbours
from flcav.federation.trainable import Update, Weights, learned_names


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
        """Return what the chosen update has learned, or the mean of the chosen ones, and the median of all else.

        Raises as `check_clients` does.
        """
        self.check_clients(len(updates))
        names = learned_names(start)
        mixed = mix_neighbours(updates, self.mixing)
        flat = flatten_updates(mixed, names)
        near = len(updates) - self.byzantine - 2
        scores = [np.sort(((flat - own) ** 2).sum(axis=1))[1 : near + 1].sum() for own in flat]
        chosen = [mixed[i] for i in np.sort(np.argsort(scores, kind="stable")[: self.kept])]
        mean = average([update.weights for update in chosen], [1.0] * len(chosen))
        rest = [name for name in start if name not in names]
        return {**mean, **take_median([{name: update.weights[name] for name in rest} for update in updates])}

    def check_clients(self, clients: int) -> None:
        """Raise `InputError` unless clients > 2 byzantine + 2, as the paper's guarantee asks, and `kept` <= clients.

        Raises as `check_mixing` does, too.
        """
        check_mixing(self.mixing, clients)
        least = max(2 * self.byzantine + 3, self.kept)
        if clients < least:
            raise InputError(
                f"krum: {least} clients or more are wanted for byzantine = {self.byzantine} and kept = {self.kept}, "
                f"and there are {clients}"
            )
