"""Client of a federated task: recording settings, sources of labels, bytes of a sample, and local training."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.files import Json
from flcav.perception.task import ConfigT, NetworkT, SampleT, Task
from flcav.perception.training import train_steps
from flcav.perception.weights import from_arrays, to_arrays

ANNOTATED = "annotated"  # kind of labels: the ground truth of the recording


@runtime_checkable
class Shared(Protocol):
    """A task with its own settings for federated training: recording, kinds of labels, bytes of a sample."""

    @property
    def recording(self) -> Mapping[str, Json]:
        """Return the fields of the recording's recipe that differ from the recipe's defaults."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the kinds of labels that clients can train on, the default first: see `flcav.pipeline.labels`."""
        ...

    def sample_bytes(self, data: Dataset, config: Any, frames: Sequence[int]) -> list[int]:
        """Return the uplink size [B] of each frame as a labelled sample."""
        ...


class WholeFrames:
    """Default settings of a task without its own: whole frames are uploaded, labelled with their ground truth."""

    recording: Mapping[str, Json] = {}
    labels = (ANNOTATED,)

    def sample_bytes(self, data: Dataset, config: Any, frames: Sequence[int]) -> list[int]:
        """Return the size [B] of each frame's point clouds, images and annotations."""
        return [data.payload_bytes(i) + picture_bytes(data, i) for i in frames]


def as_shared(task: Task) -> Shared:
    """Return the task's settings for federated training: its own, or `WholeFrames`."""
    return task if isinstance(task, Shared) else WholeFrames()


def picture_bytes(data: Dataset, i: int) -> int:
    """Return the size [B] of a frame's images as recorded (PNG)."""
    return sum(data.plane_path(i, camera, "rgb").stat().st_size for camera in data.cameras(i))


def camera_ahead(width: int, height: int, fov_deg: float) -> Mapping[str, Json]:
    """Return a rig of one forward-looking camera behind the windscreen, as the fields of a recipe.

    `width` and `height` are in pixels, `fov_deg` is the horizontal field of view.
    """
    mount, settings = {"x": 0.5, "z": 1.5}, {"width": width, "height": height, "fov_deg": fov_deg}
    return {"cameras": {"camera": {"mount": mount, "settings": settings}}}


@dataclass(frozen=True)
class TrainedWeights:
    """Result of local training."""

    weights: dict[str, NDArray[np.number]]  # by name of parameter or buffer
    samples: int  # number of distinct samples trained on
    loss: float  # mean over the steps; 0 without steps


class TaskClient(Generic[ConfigT, NetworkT, SampleT]):
    """A federated client: local training of a task's network on the client's own samples.

    It satisfies the protocol `Trainable` of `flcav.federation`, which this layer does not import. Raises `InputError`
    without samples.
    """

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
    ) -> TrainedWeights:
        """Train for `steps` steps from `weights` at a constant learning rate; deterministic in its arguments.

        Raises `InputError` if `weights` do not fit the network.
        """
        network = self.task.build(self.config)
        from_arrays(network, weights)
        loss = train_steps(
            self.task, network, self.samples, steps=steps, batch=self.batch, learning_rate=learning_rate, seed=seed
        )
        seen = min(len(self.samples), steps * min(self.batch, len(self.samples)))
        return TrainedWeights(to_arrays(network), seen, loss)
