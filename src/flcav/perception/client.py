"""Clients of a federated task: recording settings, sources of labels, messages of samples, and local training.

`TaskClient` sends weights. `OutputClient` sends class probabilities on shared samples, and its network imitates their
mean, by the cross entropy with a soft target (Hinton et al., "Distilling the Knowledge in a Neural Network", 2015, at
temperature 1).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, Generic, Protocol, cast, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from typing_extensions import TypeVar

from flcav.arrays import Array32
from flcav.config import InputError, Json
from flcav.dataset.store import Dataset
from flcav.machine.threads import use_threads
from flcav.network.ledger import from_names, pack_arrays
from flcav.perception.images import pack_pictures
from flcav.perception.task import ConfigT, NetworkT, Practice, SampleT, Task, find_configuration
from flcav.perception.training import train_steps
from flcav.perception.training.checkpoint import AdamW
from flcav.perception.weights import from_arrays, to_arrays
from flcav.statistics.streams import derive_seed

ANNOTATED = "annotated"  # kind of labels: the ground truth of the recording


@runtime_checkable
class Shared(Protocol):
    """A task with settings for federated training: recording, kinds of labels, messages of samples."""

    @property
    def recording(self) -> Mapping[str, Json]:
        """Return the fields of the recording's recipe that differ from the recipe's defaults."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the kinds of labels that clients can train on, the default first: see `flcav.runs.labels`."""
        ...

    def pack_samples(self, data: Dataset, config: Any, frames: Sequence[int]) -> Iterator[bytes]:
        """Yield the messages by which a vehicle uploads frames with their labels, one per frame.

        Raises `InputError` for frames that have no samples of the task.
        """
        ...

    def unpack_samples(self, messages: Sequence[bytes], config: Any) -> Sequence[Any] | None:
        """Return the training samples in messages of `pack_samples`; None where they are read from the recording."""
        ...


@runtime_checkable
class Compresses(Protocol):
    """A task whose samples can be uploaded in fewer bytes."""

    def compress_samples(self, messages: Iterable[bytes]) -> Iterator[bytes]:
        """Yield messages of `Shared.pack_samples`, compressed; `unpack_samples` takes either."""
        ...


@runtime_checkable
class ForVehicles(Protocol):
    """A task with networks that vehicles cannot train."""

    def check_for_vehicles(self, config: Any) -> None:
        """Raise `InputError` if vehicles cannot train a network of `config`."""
        ...


class WholeFrames:
    """Default settings of a task without `Shared`: whole frames are uploaded, labelled with their ground truth."""

    recording: Mapping[str, Json] = {}
    labels = (ANNOTATED,)

    def pack_samples(self, data: Dataset, config: Any, frames: Sequence[int]) -> Iterator[bytes]:
        """Yield the message of each frame: its point clouds, images and boxes."""
        return (pack_whole_frame(data, i) for i in frames)

    def unpack_samples(self, messages: Sequence[bytes], config: Any) -> None:
        """Return None: the task reads its samples of whole frames from the recording."""
        return


def as_shared(task: Task) -> Shared:
    """Return the task itself if it is `Shared`, otherwise `WholeFrames`."""
    return task if isinstance(task, Shared) else WholeFrames()


def check_network(task: Task, network: str | None) -> None:
    """Raise `InputError` where a task has no network of that name (None: its first), or vehicles cannot train it."""
    config = find_configuration(task, network)
    if isinstance(task, ForVehicles):
        task.check_for_vehicles(config)


def pack_whole_frame(data: Dataset, i: int) -> bytes:
    """Return a frame's message: point clouds, image files as recorded, and annotated boxes in the world frame."""
    frame = data.frame(i)
    boxes = frame.annotations.boxes
    labels = {"boxes": boxes.array(), "boxes.label": from_names(boxes.label.tolist())}
    return pack_arrays(
        {**{f"lidar.{name}": points for name, points in frame.lidar.items()}, **pack_pictures(data, i), **labels}
    )


def camera_ahead(width: int, height: int, fov_deg: float) -> Mapping[str, Json]:
    """Return a rig of one forward-looking camera behind the windscreen, as the fields of a recipe.

    `width` and `height` are in pixels, `fov_deg` is the horizontal field of view.
    """
    mount = {"x": 0.5, "z": 1.5}
    settings = {"width": width, "height": height, "fov_deg": fov_deg}
    return {"cameras": {"camera": {"mount": mount, "settings": settings}}}


@dataclass(frozen=True)
class TrainedWeights:
    """Result of local training in a federated round."""

    weights: dict[str, NDArray[np.number]]  # by name of parameter or buffer
    samples: int  # number of distinct samples trained on
    loss: float  # mean over the steps; 0 without steps
    gradient: dict[str, NDArray[np.number]] = field(default_factory=dict)  # mean over the steps, with a `shift`
    optimiser: dict[str, NDArray[np.number]] = field(default_factory=dict)  # its state after training, where given


class TaskClient(Generic[ConfigT, NetworkT, SampleT]):
    """A federated client: local training of a task's network on the client's samples.

    It satisfies the protocol `Trainable` of `flcav.federation`, which this layer does not import. Raises `InputError`
    without samples.

    Args:
        task: the task.
        config: configuration of the network.
        samples: samples of the client.
        batch: number of samples in a batch; None: that of the task.
        threads: number of CPU threads.
    """

    def __init__(
        self,
        task: Task[ConfigT, NetworkT, SampleT],
        config: ConfigT,
        samples: Sequence[SampleT],
        *,
        batch: int | None = None,
        threads: int = 1,
    ) -> None:
        if not samples:
            raise InputError("a client with 0 samples cannot train")
        self.task, self.config, self.samples = task, config, samples
        self.batch = task.practice.batch if batch is None else batch
        self.threads = threads

    def train(
        self,
        weights: Mapping[str, NDArray[np.number]],
        *,
        steps: int,
        learning_rate: float,
        seed: int,
        proximal: float = 0.0,
        shift: Mapping[str, NDArray[np.number]] | None = None,
        layers: Sequence[str] = (),
        centre: Mapping[str, NDArray[np.number]] | None = None,
        optimiser: Mapping[str, NDArray[np.number]] | None = None,
    ) -> TrainedWeights:
        """Train from given weights at a constant learning rate; deterministic in its arguments.

        The gradient of each step is g + proximal (w - centre) + shift, by name of parameter; with a `shift` the result
        has the mean of g. Raises `InputError` if `weights` or `optimiser` do not fit the network, or no parameter is
        named by `layers`.

        Args:
            weights: first weights, by name of parameter or buffer.
            steps: number of optimiser steps.
            learning_rate: step size.
            seed: seed of the batches and the augmentation.
            proximal: coefficient of the proximal term.
            shift: added to the gradient, by name of parameter; None: nothing.
            layers: patterns of the names of parameters that are trained; empty: all.
            centre: weights of the proximal term; None: `weights`.
            optimiser: state of the optimiser after an earlier training, or empty for a new one; the result then has its
                state after this training. None: a new one, whose state is not returned.
        """
        use_threads(self.threads)
        network = self.task.build(self.config)
        from_arrays(network, weights)
        freeze_others(network, layers)
        correction = None
        if proximal or shift is not None:
            correction = GradientCorrection(weights if centre is None else centre, proximal, shift)
        names = [name for name, _ in network.named_parameters()]
        adamw = AdamW(network, learning_rate)
        if optimiser:
            adamw.restore_arrays(optimiser, names)
        loss = train_steps(
            self.task,
            network,
            self.samples,
            steps=steps,
            batch=self.batch,
            learning_rate=learning_rate,
            seed=seed,
            correct=correction,
            optimizer=adamw,
        )
        gradient = correction.mean() if correction is not None and shift is not None else {}
        kept = {} if optimiser is None else adamw.to_arrays(names)
        return TrainedWeights(to_arrays(network), self.count_samples(steps), loss, gradient, kept)

    def count_samples(self, steps: int) -> int:
        """Return the number of distinct samples that `steps` steps train on."""
        return min(len(self.samples), steps * min(self.batch, len(self.samples)))


def freeze_others(network: nn.Module, layers: Sequence[str]) -> None:
    """Exclude from training all parameters whose names match none of the patterns `layers`; () excludes none.

    Raises `InputError` where none is left.
    """
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(not layers or any(fnmatchcase(name, layer) for layer in layers))
    if not any(parameter.requires_grad for parameter in network.parameters()):
        raise InputError(f"layers {', '.join(layers)}: match no parameter of the network")


class GradientCorrection:
    """Correction of gradients in local training, g + proximal (w - centre) + shift, which accumulates the g it sees."""

    def __init__(
        self,
        centre: Mapping[str, NDArray[np.number]],
        proximal: float,
        shift: Mapping[str, NDArray[np.number]] | None,
    ) -> None:
        self._centre = {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in centre.items()}
        self._shift = {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in (shift or {}).items()}
        self._proximal = proximal
        self._sum = {}
        self._steps = 0

    @torch.no_grad()
    def __call__(self, network: nn.Module) -> None:
        """Correct the gradients of the network's parameters, in place."""
        self._steps += 1
        for name, parameter in network.named_parameters():
            if parameter.grad is None:
                continue
            self._sum[name] = self._sum.get(name, 0) + parameter.grad
            if self._proximal:
                parameter.grad += self._proximal * (parameter - self._centre[name])
            if name in self._shift:
                parameter.grad += self._shift[name]

    def mean(self) -> dict[str, NDArray[np.number]]:
        """Return the mean of the uncorrected gradients over the steps, by name of parameter."""
        return {name: (total / self._steps).numpy() for name, total in self._sum.items()}


PROBABILITIES = "probabilities"  # name of the only array that is sent
SAME = 1e-6  # difference up to which probabilities are equal, and nothing is to be learned
Arrays = Mapping[str, NDArray[np.number]]
NOTHING: Arrays = {}
NetworkT_contra = TypeVar("NetworkT_contra", contravariant=True, default=Any)  # a network
SampleT_contra = TypeVar("SampleT_contra", contravariant=True, default=Any)  # a sample
Part = tuple[Any, Array32]  # a sample, and the class probabilities (rows, classes) of its contents


@runtime_checkable
class Imitates(Protocol[NetworkT_contra, SampleT_contra]):
    """A task whose networks can learn from class probabilities of samples: of pictures, or of what is seen in them."""

    def class_probabilities(self, network: NetworkT_contra, samples: Sequence[SampleT_contra]) -> list[Array32]:
        """Return the class probabilities (rows, classes) of each sample; rows depend on the sample alone."""
        ...

    def imitation_loss(
        self, network: NetworkT_contra, samples: Sequence[SampleT_contra], targets: Sequence[Array32]
    ) -> Tensor:
        """Return the loss of a batch with class probabilities for labels, as `class_probabilities` returns them."""
        ...


@dataclass(frozen=True)
class _Imitation:
    """The interface of a task that training uses, for samples `Part`."""

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
    loss: float  # mean over the steps on the client's samples
    own: Arrays = field(default_factory=dict)  # the network that stays on the client


@dataclass(frozen=True)
class SharedSamples(Generic[ConfigT, NetworkT, SampleT]):
    """Samples that clients and server share: they exchange their networks' outputs on them, and learn from the mean."""

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
        """Return the weights after local steps towards `outputs`; unchanged where the network's outputs equal them."""
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
    """A federated client that sends class probabilities on shared samples, and keeps a personal network."""

    client: TaskClient
    shared: SharedSamples
    start: Arrays  # the initial network

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
        """Train the client's network on the mean outputs `weights`, then on its samples, and return its outputs.

        `own` is the network that the client kept from its last round, empty at first.
        """
        how: Any = {"learning_rate": learning_rate, "steps": imitation_steps, "seed": derive_seed(seed, "imitation")}
        taught = self.shared.imitate(own or self.start, weights, **how)
        trained = self.client.train(taught, steps=steps, learning_rate=learning_rate, seed=seed)
        return SentOutputs(self.shared.outputs(trained.weights), trained.samples, trained.loss, trained.weights)
