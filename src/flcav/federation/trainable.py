"""The interface of a federation's client: weights in, update out.

A federation knows weights and numbers alone; whatever satisfies `Trainable` can be federated, of any task.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Weights = Mapping[str, NDArray[np.number]]  # name -> array, parameters and buffers, in a fixed order


class Update(Protocol):
    """The result of one client's local training in one round."""

    @property
    def weights(self) -> Weights:
        """The weights after local training."""
        ...

    @property
    def samples(self) -> int:
        """Number of distinct samples trained on: the client's weight in federated averaging."""
        ...

    @property
    def loss(self) -> float:
        """Mean training loss over the local steps."""
        ...


@dataclass(frozen=True)
class LocalUpdate:
    """An `Update` as a plain record."""

    weights: Weights  # after local training
    samples: int  # distinct samples trained on
    loss: float  # mean over the local steps


class Trainable(Protocol):
    """A client: its own data and a network to train on them. The network that the vehicle drives with is another."""

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> Update:
        """Return the update after `steps` local optimiser steps from `weights`, at `learning_rate`.

        `seed` determines the batches and the augmentation: the same arguments give the same update.
        """
        ...
