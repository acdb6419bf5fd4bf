"""FedYogi: Yogi on the server, with the mean change as its gradient (Reddi et al., ICLR 2021, algorithm 2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.federation.strategies.fedadam import Decay, Rate, step_adaptively
from flcav.federation.strategies.fedavgm import Floats
from flcav.federation.trainable import LocalUpdate, Update, Weights


@dataclass(frozen=True)
class FedYogi:
    """FedYogi: v <- v - (1 - beta2) change^2 sign(v - change^2), so that v falls slowly."""

    rate: Rate = 0.01  # of the server: about the size of a round's change of a weight
    beta1: Decay = 0.9
    beta2: Decay = 0.99
    tau: Rate = 1e-3  # degree of adaptivity: smaller is more adaptive

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the weights after a first round."""
        return self._step(start, updates, {})[0]

    def weigh(self, update: Update) -> float:
        """Return the update's number of samples."""
        return float(update.samples)

    def step(
        self, start: Weights, updates: Sequence[LocalUpdate], state: Weights, clients: int
    ) -> tuple[Weights, Weights]:
        """Return the weights after a round, and both moments by name of array."""
        return self._step(start, updates, state)

    def _step(self, start: Weights, updates: Sequence[Update], state: Weights) -> tuple[Weights, Weights]:
        def second(v: Floats, squared: Floats) -> Floats:
            return v - (1 - self.beta2) * squared * np.sign(v - squared)

        return step_adaptively(start, updates, state, second, self.rate, self.beta1, self.tau)
