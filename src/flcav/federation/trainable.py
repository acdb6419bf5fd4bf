"""What a federation asks of whatever it trains. It knows weights and numbers, never a task."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Weights = Mapping[str, NDArray[np.number]]  # name -> array, parameters and buffers, in a fixed order


class Update(Protocol):
    """What one client's local training produced."""

    @property
    def weights(self) -> Weights:
        """Return the weights it ended with."""
        ...

    @property
    def samples(self) -> int:
        """Return how many distinct samples it trained on: its weight in the average."""
        ...

    @property
    def loss(self) -> float:
        """Return the mean training loss over the local steps."""
        ...


@dataclass(frozen=True)
class LocalUpdate:
    """A plain `Update`."""

    weights: Weights
    samples: int
    loss: float


class Trainable(Protocol):
    """One client's copy of a task: its own data and a network to train. The network that drives is another one."""

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> Update:
        """Return the update of `steps` local steps from `weights`; the same arguments give the same update."""
        ...
