"""Corrections of clients' local steps against client drift: control variates (SCAFFOLD), a proximal term (FedProx).

Karimireddy et al., ICML 2020, algorithm 1; Li et al., MLSys 2020.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from flcav.federation.strategies.fedavg import FedAvg, average
from flcav.federation.trainable import Correction, LocalUpdate, Update, Weights, learned_names


@dataclass(frozen=True)
class Scaffold:
    """SCAFFOLD: local steps along g_i(y) - c_i + c; all clients count the same, whatever their numbers of samples.

    The variate of a client is its mean gradient over the round's local steps, which for gradient descent is option II
    of the paper, c_i - c + (x - y_i) / (K rate), and which other optimisers have, too. An update is twice as large as
    one of federated averaging.
    """

    rate: Annotated[float, Field(gt=0, le=1e3)] = 1.0  # of the server

    def weigh(self, update: Update) -> float:
        """Return 1: all clients count the same."""
        return 1.0

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return start + rate (mean - start) of learned arrays, and the mean of all others."""
        mean = average([update.weights for update in updates], [1.0] * len(updates))
        if self.rate != 1.0:
            for name in learned_names(start):
                before = start[name].astype(np.float64)
                mean[name] = (before + self.rate * (mean[name] - before)).astype(start[name].dtype)
        return mean

    def step(
        self, start: Weights, updates: Sequence[LocalUpdate], state: Weights, clients: int
    ) -> tuple[Weights, Weights]:
        """Return the weights after a round, and the server's variate c <- c + sum_i (change of c_i) / clients."""
        # divided by the number of all clients, not only of those in the round
        variate = {
            name: state.get(name, np.zeros_like(start[name]))
            + (np.sum([update.extra[name] for update in updates], axis=0, dtype=np.float64) / clients).astype(
                start[name].dtype
            )
            for name in (updates[0].extra if updates else ())
        }
        return self.combine(start, updates), variate

    def send(self, state: Weights) -> Weights:
        """Return the server's variate c."""
        return state

    def correct(self, sent: Weights, own: Weights) -> Correction:
        """Return the shift of the gradients, c - c_i."""
        return Correction(shift={name: array - own.get(name, np.zeros_like(array)) for name, array in sent.items()})

    def report(self, update: LocalUpdate, sent: Weights, own: Weights) -> tuple[Weights, Weights]:
        """Return the change of the client's variate c_i, and the variate."""
        variate = update.gradient
        return {name: array - own.get(name, np.zeros_like(array)) for name, array in variate.items()}, variate


@dataclass(frozen=True)
class FedProx:
    """FedProx: clients minimise F(w) + mu / 2 |w - start|^2 (algorithm 2), the server averages by samples."""

    mu: Annotated[float, Field(ge=0, le=1e6)] = 0.01  # weight of the proximal term

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the mean of the updates' weights, weighted by samples."""
        return FedAvg().combine(start, updates)

    def weigh(self, update: Update) -> float:
        """Return the update's number of samples."""
        return float(update.samples)

    def correct(self, sent: Weights, own: Weights) -> Correction:
        """Return the gradient of the proximal term, mu (w - start)."""
        return Correction(proximal=self.mu)
