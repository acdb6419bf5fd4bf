"""FedAvgM: federated averaging with server momentum (Hsu, Qi and Brown, arXiv 1909.06335, 2019, section 4.3)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.federation.strategies.fedavg import FedAvg, Floats
from flcav.federation.trainable import LocalUpdate, Update, Weights, learned_names


def move_mean(
    start: Weights, updates: Sequence[Update], moved: Callable[[str, Floats, Floats], Floats]
) -> dict[str, NDArray[np.number]]:
    """Return the mean of the updates, with each learned array replaced by `moved(name, start, mean - start)`.

    Statistics of batch normalisation and integers are those of federated averaging: they have no gradient.
    """
    mean = dict(FedAvg().combine(start, updates))
    for name in learned_names(start):
        before = start[name].astype(np.float64)
        mean[name] = moved(name, before, mean[name].astype(np.float64) - before).astype(start[name].dtype)
    return mean


@dataclass(frozen=True)
class FedAvgM:
    """Federated averaging with server momentum: v <- momentum v + (mean - start), start <- start + rate v."""

    rate: Annotated[float, Field(gt=0, le=1e3)] = 1.0  # of the server
    momentum: Annotated[float, Field(ge=0, lt=1)] = 0.9

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the weights after a first round."""
        return self._step(start, updates, {})[0]

    def weigh(self, update: Update) -> float:
        """Return the update's number of samples."""
        return float(update.samples)

    def step(
        self, start: Weights, updates: Sequence[LocalUpdate], state: Weights, clients: int
    ) -> tuple[Weights, Weights]:
        """Return the weights after a round, and the velocity by name of array."""
        return self._step(start, updates, state)

    def _step(self, start: Weights, updates: Sequence[Update], state: Weights) -> tuple[Weights, Weights]:
        velocity: dict[str, Floats] = {}

        def moved(name: str, before: Floats, change: Floats) -> Floats:
            velocity[name] = self.momentum * np.asarray(state.get(name, 0.0 * before), np.float64) + change
            return before + self.rate * velocity[name]

        return move_mean(start, updates, moved), velocity
