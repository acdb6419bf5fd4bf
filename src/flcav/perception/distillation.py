"""Learning from class probabilities: a client that sends them instead of weights, and a network that imitates them.

The loss is the cross entropy with a soft target (Hinton et al., "Distilling the Knowledge in a Neural Network", 2015,
at temperature 1).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn
from typing_extensions import TypeVar

from flcav.perception.client import TaskClient
from flcav.perception.task import ConfigT, NetworkT, Practice, SampleT, Task
from flcav.perception.training import train_steps
from flcav.perception.weights import from_arrays, to_arrays
from flcav.statistics.streams import derive_seed

PROBABILITIES = "probabilities"  # name of the one array that is sent
SAME = 1e-6  # difference up to which probabilities teach nothing
Arrays = Mapping[str, NDArray[np.number]]
NOTHING: Arrays = {}
NetworkT_contra = TypeVar("NetworkT_contra", contravariant=True, default=Any)  # a network
SampleT_contra = TypeVar("SampleT_contra", contravariant=True, default=Any)  # a sample
Part = tuple[Any, NDArray[np.float32]]  # a sample, and the class probabilities (rows, classes) of what it shows


@runtime_checkable
class Imitates(Protocol[NetworkT_contra, SampleT_contra]):
    """A task whose networks can learn from class probabilities of samples: of pictures, or of what is seen in them."""

    def class_probabilities(
        self, network: NetworkT_contra, samples: Sequence[SampleT_contra]
    ) -> list[NDArray[np.float32]]:
        """Return the class probabilities (rows, classes) of each sample; the number of rows is the sample's alone."""
        ...

    def imitation_loss(
        self, network: NetworkT_contra, samples: Sequence[SampleT_contra], targets: Sequence[NDArray[np.float32]]
    ) -> Tensor:
        """Return the loss of a batch with class probabilities for labels, as `class_probabilities` returns them."""
        ...


@dataclass(frozen=True)
class _Imitation:
    """The parts of a task that training uses, with samples `Part`."""

    task: Task

    @property
    def name(self) -> str:
        return self.task.name

    @property
    def practice(self) -> Practice:
        return self.task.practice

    def draw(self, samples: Sequence[Part], index: int, config: Any, rng: np.random.Generator) -> Part:
        return samples[index]

    def loss(self, network: nn.Module, samples: Sequence[Part]) -> Tensor:
        return cast(Imitates, self.task).imitation_loss(network, *map(list, zip(*samples, strict=True)))


@dataclass(frozen=True)
class SentOutputs:
    """Result of local training: the probabilities that are sent, and the network that is kept."""

    weights: Arrays  # `PROBABILITIES`
    samples: int  # number of distinct samples trained on
    loss: float  # mean over the steps on own samples
    own: Arrays = field(default_factory=dict)  # the network


@dataclass(frozen=True)
class SharedSamples(Generic[ConfigT, NetworkT, SampleT]):
    """Samples that clients and server share, to say what their networks see in them and to learn from the mean."""

    task: Task[ConfigT, NetworkT, SampleT]  # which `Imitates`
    config: ConfigT  # of all networks
    samples: Sequence[SampleT]
    batch: int

    def _build(self, weights: Arrays) -> NetworkT:
        """Return a network with these weights."""
        network = self.task.build(self.config)
        from_arrays(network, weights)
        return network

    def outputs(self, weights: Arrays) -> dict[str, NDArray[np.number]]:
        """Return the class probabilities (rows, classes), as `PROBABILITIES`, by a network with these weights."""
        rows = cast(Imitates, self.task).class_probabilities(self._build(weights), self.samples)
        return {PROBABILITIES: np.concatenate(rows).astype(np.float32)}

    def imitate(self, weights: Arrays, outputs: Arrays, *, steps: int, learning_rate: float, seed: int) -> Arrays:
        """Return the weights after local steps towards `outputs`; those given where they say the same already."""
        now = cast(Imitates, self.task).class_probabilities(network := self._build(weights), self.samples)
        wanted = np.asarray(outputs[PROBABILITIES], np.float32)
        if np.allclose(np.concatenate(now), wanted, rtol=0.0, atol=SAME):
            return weights
        ends = np.cumsum([len(rows) for rows in now])[:-1]
        parts: list[Part] = [*zip(self.samples, np.split(wanted.clip(0.0, 1.0), ends), strict=True)]
        how: Any = {"steps": steps, "batch": self.batch, "learning_rate": learning_rate, "seed": seed}
        train_steps(cast(Task, _Imitation(self.task)), network, parts, **how)
        return to_arrays(network)


@dataclass(frozen=True)
class OutputClient:
    """A federated client that sends class probabilities on shared samples, and keeps a network of its own."""

    client: TaskClient
    shared: SharedSamples
    start: Arrays  # the network that it begins with

    def train(
        self,
        weights: Arrays,
        *,
        steps: int,
        learning_rate: float,
        seed: int,
        own: Arrays = NOTHING,
        imitation_steps: int = 1,
    ) -> SentOutputs:
        """Return the probabilities by its network after learning from the mean, `weights`, and from its own samples.

        `own` is the network that it kept, empty at first.
        """
        how: Any = {"learning_rate": learning_rate, "steps": imitation_steps, "seed": derive_seed(seed, "imitation")}
        taught = self.shared.imitate(own or self.start, weights, **how)
        trained = self.client.train(taught, steps=steps, learning_rate=learning_rate, seed=seed)
        return SentOutputs(self.shared.outputs(trained.weights), trained.samples, trained.loss, trained.weights)
