"""The interface of a federation's client: weights in, update out.

A federation only sees weights and numbers, so that any `Trainable` can be federated, whatever its task.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypedDict, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError

Arrays = dict[str, NDArray[np.number]]  # by name
Weights = Mapping[str, NDArray[np.number]]  # arrays by name, parameters and buffers, in a fixed order
Forms = Mapping[str, tuple[tuple[int, ...], np.dtype]]  # shape and dtype of arrays, by name
STATISTICS = (  # of batch normalisation, last part of a name: PyTorch's, and those of the package's layer
    "running_mean",
    "running_var",
    "running_variance",
    "num_batches_tracked",
)


def forms_of(weights: Weights) -> Forms:
    """Return shape and dtype of every array."""
    return {name: (array.shape, array.dtype) for name, array in weights.items()}


def learned_names(weights: Weights) -> list[str]:
    """Return the names of the learned parameters: floating arrays without the statistics of batch normalisation."""
    return [
        name
        for name, array in weights.items()
        if np.issubdtype(array.dtype, np.floating) and name.rpartition(".")[2] not in STATISTICS
    ]


def statistics_names(weights: Weights) -> list[str]:
    """Return the names of the running means and variances of batch normalisation, which no gradient changes."""
    learned = {*learned_names(weights)}
    return [name for name, array in weights.items() if np.issubdtype(array.dtype, np.floating) and name not in learned]


def check_weights(weights: Weights, told: str) -> None:
    """Raise `InputError` where weights are not finite arrays of numbers; the message starts with `told`."""
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
    extra: Weights = field(default_factory=dict)  # further arrays of the strategy's clients, see `Exchanges`
    own: Weights = field(default_factory=dict)  # client state for the next round, where `own` was given
    optimiser: Weights = field(default_factory=dict)  # state of the optimiser after the steps, where it was given


class CorrectionArguments(TypedDict, total=False):
    """Arguments of `Trainable.train` by which a client corrects its gradients, as `Correction` has them."""

    proximal: float
    shift: Weights
    centre: Weights


@dataclass(frozen=True)
class Correction:
    """A correction of a client's gradients at every local step: g + proximal (w - centre) + shift.

    Where there is a `shift`, the update must have the mean of g over the steps as its `gradient`.
    """

    proximal: float = 0.0  # mu
    shift: Weights | None = None  # by name of parameter; missing ones are not shifted
    centre: Weights | None = None  # by name of parameter; None: the weights at the start of the round

    def arguments(self) -> CorrectionArguments:
        """Return the correction as arguments of `Trainable.train`: none where nothing is corrected."""
        found: CorrectionArguments = {"proximal": self.proximal} if self.proximal else {}
        if self.shift is not None:
            found["shift"] = self.shift
        if self.centre is not None:
            found["centre"] = self.centre
        return found


class Trainable(Protocol):
    """A client of a federation: private data and a network to train on them, not that which the vehicle drives with.

    `train` takes further arguments where the federation needs them: those of `Correction` where the strategy corrects
    gradients; `layers`, patterns of the parameters to train, where only named layers are exchanged; for FedMD `own`,
    the client's state, and `imitation_steps`, with mean outputs in place of weights; and `optimiser` where the rules
    keep optimisers: the state after the client's last round, empty at first, which the update has as `optimiser` after
    this one.
    """

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> Update:
        """Return the update after `steps` local optimiser steps from `weights`, at `learning_rate`.

        `seed` determines the batches and the augmentation: the same arguments give the same update.
        """
        ...


@runtime_checkable
class Counts(Protocol):
    """A client that can report its number of samples before it trains."""

    def count_samples(self, steps: int) -> int:
        """Return the number of distinct samples that `steps` local steps train on: the update's `samples`."""
        ...


def count_samples(client: Trainable, steps: int) -> int:
    """Return the number of samples of a client that is `Counts`; raises TypeError for any other client."""
    if not isinstance(client, Counts):
        raise TypeError(f"{type(client).__name__} does not say how many samples it has: no count_samples")
    return client.count_samples(steps)


@runtime_checkable
class Accounts(Protocol):
    """A client that is itself a server, and whose training may exceed the budget of its link: an edge server."""

    account: Any  # of that link, `flcav.federation.links.metered.Account`


@runtime_checkable
class Answers(Protocol):
    """A client that also answers questions about its data, which stay with it."""

    def answer(self, question: str, arrays: Weights) -> Weights:
        """Return the answer to a question that comes with `arrays`, such as the weights to score."""
        ...


def answer_question(client: Trainable, question: str, arrays: Weights) -> Weights:
    """Return the answer of a client that is `Answers`; raises TypeError for any other client."""
    if not isinstance(client, Answers):
        raise TypeError(f"{type(client).__name__} answers no questions, such as '{question}'")
    return client.answer(question, arrays)


class Distiller(Protocol):
    """The server's network in output distillation: it predicts on shared samples, and learns from mean outputs."""

    def outputs(self, weights: Weights) -> Weights:
        """Return the outputs of a network with these weights."""
        ...

    def imitate(self, weights: Weights, outputs: Weights, *, steps: int, learning_rate: float, seed: int) -> Weights:
        """Return the weights after local steps towards `outputs`."""
        ...
