"""The interface of a federation's client: weights in, update out.

A federation knows weights and numbers alone; whatever satisfies `Trainable` can be federated, of any task.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError

Arrays = dict[str, NDArray[np.number]]  # by name
Weights = Mapping[str, NDArray[np.number]]  # name -> array, parameters and buffers, in a fixed order
Forms = Mapping[str, tuple[tuple[int, ...], np.dtype]]  # shape and type of arrays by name
STATISTICS = (  # of batch normalisation, last part of a name: PyTorch's, and those of the package's own layer
    "running_mean",
    "running_var",
    "running_variance",
    "num_batches_tracked",
)


def forms_of(weights: Weights) -> Forms:
    """Return shape and type of each array."""
    return {name: (array.shape, array.dtype) for name, array in weights.items()}


def learned_names(weights: Weights) -> list[str]:
    """Return the names of the arrays that gradients change: floating ones, without batch normalisation's statistics."""
    return [
        name
        for name, array in weights.items()
        if np.issubdtype(array.dtype, np.floating) and name.rpartition(".")[2] not in STATISTICS
    ]


def statistics_names(weights: Weights) -> list[str]:
    """Return the names of the floating arrays that no gradient changes: batch normalisation's means and variances."""
    learned = {*learned_names(weights)}
    return [name for name, array in weights.items() if np.issubdtype(array.dtype, np.floating) and name not in learned]


def check_weights(weights: Weights, told: str) -> None:
    """Raise `InputError` where weights are not finite arrays of numbers; `told` begins the sentence."""
    for name, array in weights.items():
        if not isinstance(array, np.ndarray | np.generic) or array.dtype.kind not in "fiub":
            kind = f" of {dtype}" if (dtype := getattr(array, "dtype", None)) else ""
            raise InputError(
                f"{told}: '{name}' is {type(array).__name__}{kind}, and arrays of NumPy's numbers are wanted"
            )
        if not (finite := np.isfinite(array)).all():
            raise InputError(
                f"{told}: {np.size(array) - finite.sum()} of {np.size(array)} values of '{name}' are not finite"
            )


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
    gradient: Weights = field(default_factory=dict)  # mean over the local steps, uncorrected; where `shift` was given
    extra: Weights = field(default_factory=dict)  # what else a strategy's clients send: see `Exchanges`
    own: Weights = field(default_factory=dict)  # what a client keeps for the next round, where `own` was given
    optimiser: Weights = field(default_factory=dict)  # state of the optimiser after the steps, where it was given


@dataclass(frozen=True)
class Correction:
    """A change of a client's gradients at every local step: g + proximal (w - centre) + shift.

    The mean of g over the steps is to be returned as the update's `gradient` where there is a `shift`.
    """

    proximal: float = 0.0  # mu
    shift: Weights | None = None  # by name of parameter; one that is not in it is not shifted
    centre: Weights | None = None  # by name of parameter; None: the weights that the round began with

    def arguments(self) -> dict[str, Any]:
        """Return the further arguments of `Trainable.train`: none where nothing is corrected."""
        found: dict[str, Any] = {"proximal": self.proximal} if self.proximal else {}
        arrays = {"shift": self.shift, "centre": self.centre}
        return found | {name: each for name, each in arrays.items() if each is not None}


class Trainable(Protocol):
    """A client: its own data and a network to train on them. The network that the vehicle drives with is another.

    Strategies that correct the clients' gradients need a `train` that takes the arguments of `Correction`, too, and
    federations that exchange named layers alone need one that takes `layers`, patterns of the parameters to train.
    Clients of FedMD get their mean outputs for weights, `own`, what they kept, and `imitation_steps`. Where rules have
    clients keep their optimisers, `train` takes `optimiser`, the state after their last round, empty at first, and the
    update has it as `optimiser` after this one.
    """

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> Update:
        """Return the update after `steps` local optimiser steps from `weights`, at `learning_rate`.

        `seed` determines the batches and the augmentation: the same arguments give the same update.
        """
        ...


@runtime_checkable
class Counts(Protocol):
    """A client that reports its number of samples before it trains."""

    def count_samples(self, steps: int) -> int:
        """Return the number of distinct samples that `steps` local steps train on: the update's `samples`."""
        ...


def count_samples(client: Trainable, steps: int) -> int:
    """Return the number of samples of a client that `Counts`; raises TypeError for any other client."""
    if not isinstance(client, Counts):
        raise TypeError(f"{type(client).__name__} does not say how many samples it has: no count_samples")
    return client.count_samples(steps)


@runtime_checkable
class Accounts(Protocol):
    """A client with a link of its own to clients, whose budget its training may exceed: an edge server."""

    account: Any  # of that link, `flcav.federation.links.metered.Account`


@runtime_checkable
class Answers(Protocol):
    """A client that answers questions beside its training, on data that stay with it."""

    def answer(self, question: str, arrays: Weights) -> Weights:
        """Return the answer to a question; `arrays` come with it, such as the weights to score."""
        ...


def answer_question(client: Trainable, question: str, arrays: Weights) -> Weights:
    """Return the answer of a client that `Answers`; raises TypeError for any other client."""
    if not isinstance(client, Answers):
        raise TypeError(f"{type(client).__name__} answers no questions, such as '{question}'")
    return client.answer(question, arrays)


class Distiller(Protocol):
    """Network of the server in output distillation: its outputs on shared samples, and training towards a mean."""

    def outputs(self, weights: Weights) -> Weights:
        """Return the outputs of a network with these weights."""
        ...

    def imitate(self, weights: Weights, outputs: Weights, *, steps: int, learning_rate: float, seed: int) -> Weights:
        """Return the weights after local steps towards `outputs`."""
        ...
