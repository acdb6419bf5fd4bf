"""FedMD: federated distillation of class probabilities (Li and Wang, NeurIPS workshop 2019, algorithm 1).

Jeong et al., 2018, have the idea, with a mean per class instead of per shared sample; Itahara et al., IEEE TMC 2023,
that the server learns from the mean, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from flcav.federation.strategies.fedavg import average
from flcav.federation.trainable import Update, Weights


@dataclass(frozen=True)
class FedMD:
    """FedMD: clients send class probabilities on shared samples instead of weights, and the server averages them.

    Arrays of a round are these probabilities. Every client keeps a private network, which first takes `steps` local
    steps towards the mean and then those on the client's samples; the server's network only takes the former. All
    clients have equal weights.
    """

    frames: Annotated[int, Field(ge=1, le=10**6)] = 64  # at most so many are shared, of those uploaded in stage I
    steps: Annotated[int, Field(ge=1, le=10**6)] = 20  # towards the mean, per round

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the mean of the clients' probabilities."""
        return average([update.weights for update in updates], [1.0] * len(updates))

    def weigh(self, update: Update) -> float:
        """Return 1: all clients count the same."""
        return 1.0
