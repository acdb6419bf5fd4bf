"""A task as the client of a federation: what a sample costs to send, and local training."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.perception.task import ConfigT, NetworkT, SampleT, Task
from flcav.perception.training import train_steps
from flcav.perception.weights import from_arrays, to_arrays

ANNOTATED = "annotated"


@runtime_checkable
class Shared(Protocol):
    """A task that vehicles train together."""

    @property
    def recording(self) -> Mapping[str, Any]:
        """Return the fields of a recording's recipe in which the task differs from its defaults."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the kinds of labels that vehicles can learn from, the default first: see `flcav.pipeline.labels`."""
        ...

    def sample_bytes(self, data: Dataset, config: Any, frames: Sequence[int]) -> list[int]:
        """Return the bytes of each frame as a labelled sample that a vehicle uploads."""
        ...


class WholeFrames:
    """A task of which no more is known: whole frames are uploaded, with the labels that they were recorded with."""

    recording: Mapping[str, Any] = {}
    labels = (ANNOTATED,)

    def sample_bytes(self, data: Dataset, config: Any, frames: Sequence[int]) -> list[int]:
        """Return the bytes of point clouds, pictures and annotations."""
        return [data.payload_bytes(i) + picture_bytes(data, i) for i in frames]


def shared(task: Task) -> Shared:
    """Return how vehicles share the task."""
    return task if isinstance(task, Shared) else WholeFrames()


def picture_bytes(data: Dataset, i: int) -> int:
    """Return the bytes of a frame's pictures as they are recorded (PNG)."""
    return sum(data.plane_path(i, camera, "rgb").stat().st_size for camera in data.cameras(i))


def camera_ahead(width: int, height: int, fov_deg: float) -> Mapping[str, Any]:
    """Return a rig of one camera that looks ahead from behind the windscreen, as a recipe has it."""
    mount, settings = {"x": 0.5, "z": 1.5}, {"width": width, "height": height, "fov_deg": fov_deg}
    return {"cameras": {"camera": {"mount": mount, "settings": settings}}}


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
