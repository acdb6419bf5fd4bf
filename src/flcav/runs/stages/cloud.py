"""The cloud in stage III: it averages, and may train on the samples of stage I, by replay or ensemble distillation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.trainable import Update, Weights
from flcav.federation.wire import LocalWork
from flcav.perception.client import TaskClient
from flcav.perception.objects.distillation import TaughtObjects
from flcav.perception.weights import from_arrays
from flcav.runs.recipe import CloudDistillation
from flcav.statistics.streams import derive_seed

RoundWork = Callable[[], LocalWork]  # of the round that is combined: its learning rate and seed


@dataclass(frozen=True)
class Replay:
    """The cloud's training on the samples of stage I, weighted as if it had a given number of samples."""

    client: TaskClient
    samples: int

    def train(self, weights: Weights, **how: Any) -> Update:
        """Return the update of `TaskClient.train`, with that number of samples."""
        return replace(self.client.train(weights, **how), samples=self.samples)


@dataclass(frozen=True)
class EnsembleDistillation(FedAvg):
    """Ensemble distillation of detectors (FedDF: Lin et al., NeurIPS 2020, algorithm 1).

    The mean of the updates, as of `FedAvg`, learns from the networks of all of them at once and from labels, on the
    client's samples.
    """

    client: TaskClient
    how: CloudDistillation
    work: RoundWork

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the taught mean of the updates; raises ValueError as `average` does."""
        own, work = self.client, self.work()
        teachers = [own.task.build(own.config) for _ in updates]
        for teacher, update in zip(teachers, updates, strict=True):
            from_arrays(teacher, update.weights)
        pupil = TaskClient(TaughtObjects(teachers, self.how.weight), own.config, own.samples, batch=own.batch)
        seed = derive_seed(work.seed, "cloud-distillation")
        taught = pupil.train(
            super().combine(start, updates), steps=self.how.steps, learning_rate=work.learning_rate, seed=seed
        )
        return taught.weights


@dataclass(frozen=True)
class CloudServer:
    """The cloud's tasks in stage III besides averaging."""

    keeps_statistics: bool = False  # whether the regions' statistics of batch normalisation are written, too
    replay: TaskClient | None = None  # client that trains on the samples of stage I
    replay_share: float = 0.0  # weight of its update in an average, in [0, 1)
    topics: str | None = None  # ROS namespace by which edge servers and cloud exchange messages; None: in memory
    distil: Callable[[RoundWork], EnsembleDistillation] | None = None  # strategy of its averages; None: the recipe's
