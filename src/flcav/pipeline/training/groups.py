"""Groups of edge FL: who asks, who is called, and when a group dissolves (Wang et al., IEEE Network 37(3), 2023).

A vehicle checks the network that drives against its own labels (of its tracks, the map or the road's boxes) on frames
that it holds back from training. Where it errs, it sends a request. Whoever is in range of it offers its data: counts
of its labels and a sketch of its gradient, by which the lead measures what the data add.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.federation.trainable import Weights
from flcav.network.ledger import Ledger
from flcav.network.messages import from_names, pack, send
from flcav.optimization.quality import data_quality, gradient_novelty, label_distribution_distance, visible_objects
from flcav.perception.client import TaskClient
from flcav.perception.task import Task
from flcav.perception.weights import from_arrays
from flcav.pipeline.recipe import EDGE, Requests
from flcav.statistics.streams import stream

Array = NDArray[np.float64]

SKETCH = 64  # numbers
SERVER_RANGE = "out of V2X range of whoever asked"
ABSENT = "not in the town"
NO_LINK = "no link to spare"
NOT_NEEDED = "its data add less"
FULL = "the group is full"


@dataclass(frozen=True)
class Offer:
    """A vehicle's offer to a group."""

    samples: int
    labels: Mapping[str, int]  # their number by class
    sketch: Array  # (SKETCH,) random projection of the gradient of its loss

    def message(self) -> bytes:
        """Return the offer as its bytes on the radio."""
        counts = np.array([*self.labels.values()], np.int64)
        return pack(
            {
                "samples": np.array([self.samples], np.int64),
                "labels": from_names(self.labels),
                "counts": counts,
                "sketch": self.sketch.astype(np.float32),
            }
        )


@dataclass(frozen=True)
class Chosen:
    """The members of a group in a region, by name, and why others stayed."""

    members: tuple[str, ...]  # those that asked first
    quality: Mapping[str, float]
    stayed: Mapping[str, str]


def hold_back(count: int, share: float) -> tuple[list[int], list[int]]:
    """Return the places of `count` samples to train on, and of those held back: evenly spread, one of each at least.

    Of a single sample nothing is held back.
    """
    held = min(max(round(share * count), 1), count - 1) if count > 1 else 0
    places = {int((number + 0.5) * count / held) for number in range(held)}
    return [i for i in range(count) if i not in places], sorted(places)


def measure_loss(task: Task, config: Any, weights: Weights, samples: Sequence[Any], batch: int) -> float:
    """Return the mean loss of a network on samples, which does not change it."""
    network = task.build(config)
    from_arrays(network, weights)
    network.eval()
    total = 0.0
    with torch.no_grad():
        for first in range(0, len(samples), batch):
            part = [samples[place] for place in range(first, min(first + batch, len(samples)))]
            total += float(task.loss(network, part)) * len(part)
    return total / len(samples)


def count_labels(samples: Sequence[Any]) -> dict[str, int]:
    """Return the number of labels by class, where the task's samples have classes."""
    counts: Counter[str] = Counter()
    for number in range(len(samples)):
        sample = samples[number]
        label = getattr(sample, "label", None)
        label = getattr(getattr(sample, "boxes", None), "label", ()) if label is None else label
        counts.update(map(str, np.atleast_1d(np.asarray(label)).tolist()))
    return dict(sorted(counts.items()))


def find_gradient(client: TaskClient, weights: Weights, seed: int) -> Weights:
    """Return the gradient of a client's loss on one batch, at `weights`."""
    return client.train(weights, steps=1, learning_rate=1e-9, seed=seed, shift={}).gradient


def sketch_gradient(gradient: Weights, seed: int) -> Array:
    """Return a random projection (SKETCH,) of a gradient.

    Projections of all clients by one seed keep the angles between their gradients up to some 1 / sqrt(SKETCH).
    """
    sketch = np.zeros(SKETCH)
    for name, array in gradient.items():
        flat = np.asarray(array, np.float64).ravel()
        draws = stream(seed, "sketch", name)
        for row in range(SKETCH):
            sketch[row] += float(flat @ draws.standard_normal(flat.size))
    return sketch


def weigh_offers(offers: Mapping[str, Offer]) -> dict[str, float]:
    """Return the quality in (0, 1] of each offer's data: by labels, objects seen and novelty of the gradient.

    A task without classes is judged by its gradients alone.
    """
    classes = sorted({label for offer in offers.values() for label in offer.labels})
    counts = np.array([[offer.labels.get(label, 0) for label in classes] for offer in offers.values()])
    distance = label_distribution_distance(counts) if classes else np.zeros(len(offers))
    novelty = gradient_novelty([offer.sketch for offer in offers.values()])
    seen = visible_objects(counts.sum(axis=1), [offer.samples for offer in offers.values()]) if classes else None
    return dict(zip(offers, data_quality(distance, seen, novelty).tolist(), strict=True))


def find_in_range(positions: Mapping[str, Array], of: Sequence[str], range_m: float) -> list[str]:
    """Return the clients within `range_m` of one of the clients `of`, who are among them; positions (3,) [m]."""
    centres = [positions[name] for name in of if name in positions]
    near = lambda own: any(np.linalg.norm(own - each) <= range_m for each in centres)  # noqa: E731
    return [name for name, own in positions.items() if name in of or near(own)]


def find_lead(
    positions: Mapping[str, Array], asked: Sequence[str], servers: Mapping[str, Array], range_m: float
) -> str:
    """Return who leads: the nearest edge server in range of one that asked, or else the lowest identifier in range.

    positions: (3,) [m] of the vehicles that are there, by client; servers: (3,) [m] of edge servers by name.
    """
    distances = {
        server: min(
            (float(np.linalg.norm(positions[name] - at)) for name in asked if name in positions), default=np.inf
        )
        for server, at in servers.items()
    }
    nearest = min(distances, key=lambda server: distances[server], default=None)
    if nearest is not None and distances[nearest] <= range_m:
        return nearest
    return min(find_in_range(positions, asked, range_m) or asked)


def choose_members(
    how: Requests,
    asked: Sequence[str],
    quality: Mapping[str, float],
    stayed: Mapping[str, str],
    most: int | None = None,
) -> Chosen:
    """Return the group: who asked, and of the others those whose data are good enough, the best first.

    asked: those that made an offer, who errs most first; quality: of all who made one; stayed: why others made none;
    most: members by the plan, None: those of `how`.
    """
    others = sorted((name for name in quality if name not in asked), key=lambda name: (-quality[name], name))
    good = [name for name in others if quality[name] >= how.least_quality * max(quality.values())]
    came = (*asked, *good)[: most or how.most]
    left = {name: NOT_NEEDED for name in others if name not in good} | dict.fromkeys((*asked, *good)[len(came) :], FULL)
    return Chosen(came, quality, {**stayed, **left})


def has_levelled(losses: Sequence[float], how: Requests) -> bool:
    """Return whether the loss has levelled off: the last `patience` rounds lowered its least by too small a share.

    losses: before the first round, and after each.
    """
    if len(losses) <= how.patience:
        return False
    best = min(losses[: -how.patience])
    return min(losses[-how.patience :]) > best - how.least_gain * abs(best)


class Picked(Sequence[Any]):
    """Some of a vehicle's samples, by their places."""

    def __init__(self, samples: Sequence[Any], places: Sequence[int]) -> None:
        self._samples, self._places = samples, tuple(places)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self._samples[place] for place in self._places[index]]
        return self._samples[self._places[index]]


class Levelled(Exception):
    """The loss of a group has levelled off: it dissolves."""


@dataclass
class GroupWatch:
    """Watch over a group's loss on what its members hold back, round by round."""

    task: Task
    config: Any
    batch: int
    how: Requests
    held: Mapping[str, Sequence[Any]]  # of the members, by client
    losses: list[float] = field(default_factory=list)  # before the first round, and after each

    def measure(self, weights: Weights) -> dict[str, float]:
        """Return the loss of each member that holds samples back."""
        return {
            name: measure_loss(self.task, self.config, weights, own, self.batch)
            for name, own in self.held.items()
            if len(own)
        }

    def note(self, weights: Weights) -> None:
        """Note the mean loss of the members."""
        found = self.measure(weights)
        self.losses.append(float(np.mean([*found.values()])) if found else 0.0)

    def tell(self, book: Ledger, round_: int) -> None:
        """Enter the members' messages of their losses after a round; raises `BudgetExceeded`."""
        message = pack({"loss": np.zeros(1, np.float32)})
        for name, own in self.held.items():
            if len(own):
                about: Any = {"stage": EDGE, "task": self.task.name, "link": "wireless", "direction": "up"}
                send(book, message, client=name, round_=round_, **about)

    @property
    def over(self) -> bool:
        """Return whether the loss has levelled off; that of members who hold nothing back never does."""
        return any(len(own) for own in self.held.values()) and has_levelled(self.losses, self.how)
