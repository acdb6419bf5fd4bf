"""One federation client of a task: its samples, and local steps on weights that come as arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.perception.task import ConfigT, NetworkT, SampleT, Task
from flcav.perception.training import train_steps
from flcav.perception.weights import from_arrays, to_arrays


@dataclass(frozen=True)
class Trained:
    """What local training produced."""

    weights: dict[str, NDArray[np.number]]
    samples: int  # distinct samples trained on
    loss: float  # mean over the steps


class TaskClient(Generic[ConfigT, NetworkT, SampleT]):
    """A vehicle's copy of a task's network; shaped as federation's `Trainable`, which this layer does not import."""

    def __init__(
        self,
        task: Task[ConfigT, NetworkT, SampleT],
        config: ConfigT,
        samples: Sequence[SampleT],
        *,
        batch: int | None = None,
    ) -> None:
        if not samples:
            raise InputError("a client with 0 samples cannot train")
        self.task, self.config, self.samples = task, config, samples
        self.batch = task.practice.batch if batch is None else batch

    def train(
        self, weights: Mapping[str, NDArray[np.number]], *, steps: int, learning_rate: float, seed: int
    ) -> Trained:
        """Return the weights after `steps` local steps from `weights`; the same arguments give the same result."""
        network = self.task.build(self.config)
        from_arrays(network, weights)
        loss = train_steps(
            self.task, network, self.samples, steps=steps, batch=self.batch, learning_rate=learning_rate, seed=seed
        )
        seen = min(len(self.samples), steps * min(self.batch, len(self.samples)))
        return Trained(to_arrays(network), seen, loss)
