"""FedProx: federated averaging of clients that are held near the round's weights (Li et al., MLSys 2020)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.trainable import Correction, Update, Weights


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
