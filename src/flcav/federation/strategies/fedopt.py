"""Server optimisers, which use the mean change of a round as the gradient of a step on the server.

FedAdam and FedYogi (Reddi et al., "Adaptive Federated Optimization", ICLR 2021, algorithm 2), and FedAvgM, whose server
has momentum (Hsu, Qi and Brown, arXiv 1909.06335, 2019, section 4.3).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.federation.strategies.fedavg import FedAvg, Floats
from flcav.federation.trainable import LocalUpdate, Update, Weights, learned_names

FIRST, SECOND = "first/", "second/"  # prefixes of the moments' names

Rate = Annotated[float, Field(gt=0, le=1e3)]
Decay = Annotated[float, Field(ge=0, lt=1)]


class _ServerOptimiser(ABC):
    """An optimiser of the server, which takes the mean of the clients' changes for a gradient."""

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the weights after a first round."""
        return self._step(start, updates, {})[0]

    def weigh(self, update: Update) -> float:
        """Return the update's number of samples."""
        return float(update.samples)

    def step(
        self, start: Weights, updates: Sequence[LocalUpdate], state: Weights, clients: int
    ) -> tuple[Weights, Weights]:
        """Return the weights after a round, and the optimiser's state by name of array."""
        return self._step(start, updates, state)

    @abstractmethod
    def _step(self, start: Weights, updates: Sequence[Update], state: Weights) -> tuple[Weights, Weights]: ...


@dataclass(frozen=True)
class _Adaptive(_ServerOptimiser):
    """An adaptive one (algorithm 2, lines 10-15), with a rule for the second moment v.

    m <- beta1 m + (1 - beta1) change; v <- second(v, change^2); start <- start + rate m / (sqrt(v) + tau). Initially m
    is 0 and v is tau^2; there is no bias correction, as in the paper.
    """

    rate: Rate = 0.01  # of the server: about the size of a round's change of a weight
    beta1: Decay = 0.9
    beta2: Decay = 0.99
    tau: Rate = 1e-3  # degree of adaptivity: smaller is more adaptive

    @abstractmethod
    def _second(self, v: Floats, squared: Floats) -> Floats: ...

    def _step(self, start: Weights, updates: Sequence[Update], state: Weights) -> tuple[Weights, Weights]:
        moments: dict[str, Floats] = {}

        def moved(name: str, before: Floats, change: Floats) -> Floats:
            m = self.beta1 * np.asarray(state.get(FIRST + name, 0.0 * before), np.float64) + (1 - self.beta1) * change
            v = np.asarray(state.get(SECOND + name, np.full_like(before, self.tau**2)), np.float64)
            v = self._second(v, change**2)
            moments[FIRST + name], moments[SECOND + name] = m, v
            return np.asarray(before + self.rate * m / (np.sqrt(v) + self.tau))

        return move_mean(start, updates, moved), moments


@dataclass(frozen=True)
class FedAdam(_Adaptive):
    """FedAdam: v <- beta2 v + (1 - beta2) change^2."""

    def _second(self, v: Floats, squared: Floats) -> Floats:
        return self.beta2 * v + (1 - self.beta2) * squared


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
class FedAvgM(_ServerOptimiser):
    """Federated averaging with server momentum: v <- momentum v + (mean - start), start <- start + rate v."""

    rate: Annotated[float, Field(gt=0, le=1e3)] = 1.0  # of the server
    momentum: Annotated[float, Field(ge=0, lt=1)] = 0.9

    def _step(self, start: Weights, updates: Sequence[Update], state: Weights) -> tuple[Weights, Weights]:
        velocity: dict[str, Floats] = {}

        def moved(name: str, before: Floats, change: Floats) -> Floats:
            velocity[name] = self.momentum * np.asarray(state.get(name, 0.0 * before), np.float64) + change
            return before + self.rate * velocity[name]

        return move_mean(start, updates, moved), velocity


@dataclass(frozen=True)
class FedYogi(_Adaptive):
    """FedYogi: v <- v - (1 - beta2) change^2 sign(v - change^2), so that v falls slowly."""

    def _second(self, v: Floats, squared: Floats) -> Floats:
        return v - (1 - self.beta2) * squared * np.sign(v - squared)
