"""A vehicle as a member of a group: its check of the deployed network, request, offer of data, and reported loss.

It answers the lead's questions from data that stay with it, in this process or on the vehicle of a deployed fleet.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError

from flcav.federation.trainable import Trainable, Update, Weights, count_samples
from flcav.fleet.fl_request import FLRequest, parse_request
from flcav.geometry.arrays import Array
from flcav.machine.threads import use_threads
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.client import TaskClient
from flcav.perception.task import Task
from flcav.perception.weights import from_arrays
from flcav.runs.results.saved import Saved
from flcav.statistics.streams import stream

if TYPE_CHECKING:
    from flcav.federation.links.flower import RegionalDeployment

SKETCH = 64  # dimensions of the random projection of a gradient
CHECK, REQUEST, OFFER, SCORE = "check", "request", "offer", "score"  # questions
SCENE = "scene"  # array sent with the question for a request: number of the scene in which the group forms
HELD, LOSS, ASKS = "held", "loss", "asks"  # arrays of a check
MESSAGE = "message"  # array of any other answer: the bytes of a message on the radio


class Unreadable(ValueError):
    """Raised for a message that cannot be decoded as what was requested."""


@dataclass(frozen=True)
class Offer:
    """A vehicle's offer to a group."""

    samples: int
    labels: Mapping[str, int]  # number of labels by class
    sketch: Array  # (SKETCH,) random projection of the gradient of its loss

    def message(self) -> bytes:
        """Encode the offer as a message on the radio."""
        counts = np.array([*self.labels.values()], np.int64)
        return pack_arrays(
            {
                "samples": np.array([self.samples], np.int64),
                "labels": from_names(self.labels),
                "counts": counts,
                "sketch": self.sketch.astype(np.float32),
            }
        )

    @classmethod
    def read(cls, message: bytes) -> "Offer":
        """Decode the offer in a message; raises `Unreadable`."""
        found = _read(message, samples=(1,), sketch=(SKETCH,))
        samples, sketch = int(found["samples"][0]), found["sketch"].astype(np.float64)
        try:
            labels = dict(zip(to_names(found["labels"]).tolist(), found["counts"].tolist(), strict=True))
        except (KeyError, ValueError) as error:
            raise Unreadable(f"an offer's labels: {error}") from None
        if samples < 1 or min(labels.values(), default=0) < 0 or not np.isfinite(sketch).all():
            raise Unreadable("an offer of other data than samples")
        return cls(samples, labels, sketch)


def read_position(message: bytes) -> Array:
    """Decode the position (3,) in a request, world frame [m]; raises `Unreadable`."""
    return _read(message, position=(3,))["position"].astype(np.float64)


def read_loss(message: bytes) -> float:
    """Decode the loss that a member reports; raises `Unreadable`."""
    return float(_read(message, loss=(1,))["loss"][0])


def _read(message: bytes, **shapes: tuple[int, ...]) -> dict[str, NDArray[Any]]:
    """Decode the arrays of a message, and check the shapes of those in `shapes`; raises `Unreadable`."""
    try:
        found = unpack_arrays(message)
    except (SafetensorError, ValueError) as error:
        raise Unreadable(str(error)) from None
    for name, shape in shapes.items():
        if name not in found or found[name].shape != shape:
            raise Unreadable(f"a message without '{name}'")
    return found


@dataclass(frozen=True)
class GroupMember:
    """A vehicle of a region that may ask for a group, be called, and train in it; satisfies `Answers`."""

    task: Task
    config: Any
    batch: int
    data: Sequence[Any]  # training samples
    held: Sequence[Any]  # held-back samples
    network: Weights  # of the deployed network
    limit: float  # of its loss on `held`, above which the vehicle sends a request
    seed: int  # of the offers, the same for all vehicles
    places: Array  # (scenes, 3) its first positions by scene, world frame [m]; NaN if absent
    client: Trainable | None = None  # for training, if it is called

    def train(self, weights: Weights, **how: Any) -> Update:
        """Train the vehicle's client and return its update."""
        assert self.client is not None
        return self.client.train(weights, **how)

    def count_samples(self, steps: int) -> int:
        """Return the number of samples of the vehicle's client; raises TypeError if the client cannot count them."""
        assert self.client is not None
        return count_samples(self.client, steps)

    def answer(self, question: str, arrays: Weights) -> Weights:
        """Answer a question of this module; for `SCORE`, `arrays` are the weights to score."""
        use_threads(1)
        if question == CHECK:
            loss = self.driving_loss
            return {HELD: np.array([len(self.held)]), LOSS: np.array([loss]), ASKS: np.array([loss > self.limit])}
        if question == REQUEST:
            position = self.places[int(arrays[SCENE][0])].astype(np.float32)
            message = pack_arrays({"position": position, "loss": np.array([self.driving_loss], np.float32)})
        elif question == OFFER:
            message = self._offer().message()
        elif question == SCORE:
            loss = measure_loss(self.task, self.config, arrays, self.held, self.batch)
            message = pack_arrays({"loss": np.array([loss], np.float32)})
        else:
            raise ValueError(f"a question for '{question}'")
        return {MESSAGE: np.frombuffer(message, np.uint8)}

    @cached_property
    def driving_loss(self) -> float:
        """The loss of the deployed network on the vehicle's held-back samples; 0 without any."""
        if not len(self.held):
            return 0.0
        return measure_loss(self.task, self.config, self.network, self.held, self.batch)

    def _offer(self) -> Offer:
        client = TaskClient(self.task, self.config, self.data, batch=self.batch)
        sketch = sketch_gradient(find_gradient(client, self.network, self.seed), self.seed)
        return Offer(len(self.data), count_sample_labels(self.data), sketch)


def hold_back(count: int, share: float) -> tuple[list[int], list[int]]:
    """Split `count` samples into indices to train on and indices held back, evenly spread, at least one of both.

    A single sample is not held back.
    """
    held = min(max(round(share * count), 1), count - 1) if count > 1 else 0
    places = {int((number + 0.5) * count / held) for number in range(held)}
    return [i for i in range(count) if i not in places], sorted(places)


def measure_loss(task: Task, config: Any, weights: Weights, samples: Sequence[Any], batch: int) -> float:
    """Return the mean loss of a network on samples, without training it."""
    network = task.build(config)
    from_arrays(network, weights)
    network.eval()
    total = 0.0
    with torch.no_grad():
        for first in range(0, len(samples), batch):
            part = [samples[place] for place in range(first, min(first + batch, len(samples)))]
            total += float(task.loss(network, part)) * len(part)
    return total / len(samples)


def count_sample_labels(samples: Sequence[Any]) -> dict[str, int]:
    """Count the labels by class; empty where the task's samples have no classes."""
    counts: Counter[str] = Counter()
    for number in range(len(samples)):
        sample = samples[number]
        label = getattr(sample, "label", None)
        label = getattr(getattr(sample, "boxes", None), "label", ()) if label is None else label
        counts.update(map(str, np.atleast_1d(np.asarray(label)).tolist()))
    return dict(sorted(counts.items()))


def find_gradient(client: TaskClient, weights: Weights, seed: int) -> Weights:
    """Return the gradient of a client's loss on one batch, at `weights`."""
    # `train` returns the gradient if it is given a shift, here an empty one; the step itself is negligible.
    return client.train(weights, steps=1, learning_rate=1e-9, seed=seed, shift={}).gradient


def sketch_gradient(gradient: Weights, seed: int) -> Array:
    """Return the random projection (SKETCH,) of a gradient.

    Projections of all clients with the same seed preserve the angles between gradients up to about 1 / sqrt(SKETCH).
    """
    sketch = np.zeros(SKETCH)
    for name, array in gradient.items():
        flat = np.asarray(array, np.float64).ravel()
        draws = stream(seed, "sketch", name)
        for row in range(SKETCH):
            sketch[row] += float(flat @ draws.standard_normal(flat.size))
    return sketch


class Picked(Sequence[Any]):
    """A subset of a vehicle's samples, given by indices."""

    def __init__(self, samples: Sequence[Any], places: Sequence[int]) -> None:
        self._samples = samples
        self._places = tuple(places)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self._samples[place] for place in self._places[index]]
        return self._samples[self._places[index]]


@dataclass(frozen=True)
class TakenRequests(Saved):
    """FL requests for a task that were waiting when a group formed."""

    file: ClassVar[str] = "fl-requests.json"

    messages: Mapping[str, tuple[str, ...]]  # as they were sent, by client, the latest last

    def read(self) -> dict[str, FLRequest]:
        """Parse the latest requests, by client."""
        return {name: parse_request(sent[-1].encode()) for name, sent in self.messages.items()}


def take_requests(
    deployed: "RegionalDeployment | None", folder: Path, clients: Sequence[str], task: str
) -> TakenRequests:
    """Return the FL requests of a region's `clients` for a task: those saved in `folder`, or waiting in the fleet.

    They are saved before the first round, so that a resumed step forms the same group.
    """
    if (folder / TakenRequests.file).exists():
        return TakenRequests.load(folder)
    if deployed is None or not clients:
        return TakenRequests({})
    waiting = deployed.fleet_of(clients[0]).list_requests(clients, task)
    taken = TakenRequests({name: tuple(content.decode() for content in sent) for name, sent in waiting.items()})
    taken.save(folder)
    return taken


def answer_requests(deployed: "RegionalDeployment | None", taken: TakenRequests, members: Sequence[str]) -> None:
    """Mark the requests of a group's members as answered."""
    answered = [content.encode() for name, sent in taken.messages.items() if name in members for content in sent]
    if deployed is not None and answered:
        deployed.fleet_of(members[0]).answer_requests(answered)
