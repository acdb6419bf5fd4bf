"""The interface of a perception task: its networks, samples, augmentation, loss, evaluation and inference.

Everything else works with any `Task`: training (`flcav.perception.training`), files of weights
(`flcav.perception.weights`), clients of a federation (`flcav.perception.client`), the federation, the command line.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from typing_extensions import TypeVar  # in typing from Python 3.13 on, with defaults

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import suggest
from flcav.perception.marks import Mark
from flcav.statistics.streams import derive_seed
from flcav.storage.records import Record

if TYPE_CHECKING:
    from flcav.perception.images import CameraView

ConfigT = TypeVar("ConfigT", default=Any)
NetworkT = TypeVar("NetworkT", bound=nn.Module, default=Any)
SampleT = TypeVar("SampleT", default=Any)


@dataclass(frozen=True)
class Practice:
    """Default hyperparameters of a task's training."""

    batch: int  # samples per step
    learning_rate: float  # peak learning rate of AdamW
    schedule: str = "one_cycle"  # of the learning rate, one of `flcav.perception.training.SCHEDULES`


def no_view() -> None:
    """Return None: the view of an input without a camera."""


class Result(Record):
    """Base of results of a network: a frozen dataclass that converts itself to JSON and to lines of text."""

    def lines(self) -> list[str]:
        """Return the result as lines of text: one per field, unless a subclass overrides it."""
        return [f"{name}: {value}" for name, value in self.as_json().items()]


class Evaluated(Result, ABC):
    """Base of a task's evaluation: its metrics on some frames."""

    @property
    @abstractmethod
    def score(self) -> float:
        """Return the metric that validation maximises."""

    def numbers(self) -> Mapping[str, float]:
        """Return the metrics by name whose means over seeds a study reports: the score, unless a task has others."""
        return {"score": self.score}


@dataclass(frozen=True)
class Finding:
    """Result of a network on an input, with what is needed to draw it."""

    path: Path  # of the input
    seen: NDArray  # image (H, W, 3) u8, point cloud (N, 4) f32, or map: (3, H, W) bool of road, lane, crossing
    result: Result
    marks: tuple[Mark, ...] = ()  # the result as it is drawn on `seen`
    view: Callable[[], "CameraView | None"] = no_view  # reads the image of a camera with the LiDAR's direction


class Task(Protocol[ConfigT, NetworkT, SampleT]):
    """A perception task, generic in the types of its configurations, networks and samples (default: any).

    A network has its configuration as attribute `config`, a pydantic dataclass from which `build` rebuilds it.
    """

    @property
    def name(self) -> str:
        """Return the task's name on the command line."""
        ...

    @property
    def family(self) -> str:
        """Return the name of the networks' architecture, which is part of a metadata key of files of weights."""
        ...

    @property
    def configurations(self) -> Mapping[str, ConfigT]:
        """Return the configurations of networks by name, the default first."""
        ...

    @property
    def practice(self) -> Practice:
        """Return the default hyperparameters of training."""
        ...

    def build(self, config: ConfigT) -> NetworkT:
        """Return a network with random initial weights, drawn from torch's global generator."""
        ...

    def samples(self, data: Dataset, config: ConfigT, frames: Sequence[int] | None = None) -> Sequence[SampleT]:
        """Return the labelled samples of the frames of these numbers (None: all) for a network of `config`.

        Raises `InputError` if the dataset lacks what the task needs.
        """
        ...

    def draw(self, samples: Sequence[SampleT], index: int, config: ConfigT, rng: np.random.Generator) -> SampleT:
        """Return sample `index`, augmented at random by `rng`, for one training step."""
        ...

    def loss(self, network: NetworkT, samples: Sequence[SampleT]) -> Tensor:
        """Return the loss of a batch, differentiable in the network's parameters."""
        ...

    def evaluate(
        self,
        network: NetworkT,
        data: Dataset,
        frames: Sequence[int] | None = None,
        *,
        progress: Report = ignore_progress,
    ) -> Evaluated:
        """Return the task's metrics on frames of a dataset (None: all)."""
        ...

    def infer(
        self, network: NetworkT, path: Path, threshold: float, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield the finding of each input at `path`: a file, a folder of files, or `frames` of a dataset (None: all).

        Detections that score below `threshold` are left out. Raises `InputError` for a bad input.
        """
        ...


@runtime_checkable
class Calibrates(Protocol):
    """A task whose networks have their confidence scores calibrated after training, on held-out frames."""

    def calibrate(self, network: Any, data: Dataset, frames: Sequence[int] | None = None) -> None:
        """Fit the calibration of scores on frames of `data` (None: all); set it in the network's configuration."""
        ...


@runtime_checkable
class Scores(Protocol):
    """A task whose findings have confidence scores in [0, 1]."""

    @property
    def threshold(self) -> float:
        """Return the default score threshold of inference and of the error registry."""
        ...


@runtime_checkable
class RigBound(Protocol):
    """A task whose networks expect a sensor rig that not every agent has."""

    def fitting(self, data: Dataset, config: Any) -> Sequence[int]:
        """Return the numbers of the frames whose rig suits a network of `config`; may raise `InputError` for none."""
        ...


@dataclass(frozen=True)
class KnownLidar:
    """Beams and range of the agents' first LiDAR, as far as a recording names them."""

    beams: tuple[int, int] | None = None  # fewest and most, which differ where LiDARs are drawn; None: unknown
    range_m: float | None = None  # largest range [m]; None: unknown


@runtime_checkable
class KnowsRig(Protocol):
    """A task whose networks know the sensor rig that they were trained with."""

    def compare_rig(self, data: Dataset, config: Any, frames: Sequence[int], trained: KnownLidar) -> str:
        """Return how the rig of these frames differs from that of a network of `config`, in words; "" if it does not.

        `trained` is the LiDAR that the network was trained with.
        """
        ...


def find_configuration(task: Task[ConfigT, NetworkT, SampleT], name: str | None) -> ConfigT:
    """Return the configuration of that name (None: the default); raises `InputError` for an unknown name."""
    known = task.configurations
    if name is None:
        return next(iter(known.values()))
    if name not in known:
        raise InputError(f"network '{name}': choose one of {', '.join(known)}{suggest(name, known)}")
    return known[name]


def build_network(task: Task[ConfigT, NetworkT, SampleT], config: ConfigT, seed: int) -> NetworkT:
    """Return a network with random initial weights drawn from `seed`; torch's global generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(seed, "weights"))
        return task.build(config)
