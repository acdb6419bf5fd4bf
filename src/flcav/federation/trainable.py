"""What a federation asks of whatever it trains. It knows weights and numbers, never a task."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

Weights = Mapping[str, NDArray[Any]]  # name -> array, parameters and buffers, in a fixed order


@dataclass(frozen=True)
class LocalUpdate:
    """What one client's local training produced."""

    weights: Weights
    samples: int  # distinct samples it trained on: its weight in the average
    loss: float  # mean training loss over the local steps


class Trainable(Protocol):
    """One client's copy of a task: its own data and a network to train. The network that drives is another one."""

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        """Return the update of `steps` local steps from `weights`; the same arguments give the same update."""
        ...
