"""What a perception task is: its networks, its samples, its loss and its measure. All else is the same for every task.

Training is `flcav.perception.training`, files of weights are `flcav.perception.weights`, a federation's client is
`flcav.perception.client`: each works with any `Task`, and so do the command line and the federation.
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
from typing_extensions import TypeVar  # of typing from Python 3.13 on: with defaults

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.perception.marks import Mark
from flcav.progress import Report, silent
from flcav.records import Record
from flcav.seeds import child_seed

if TYPE_CHECKING:
    from flcav.perception.images import CameraView

ConfigT = TypeVar("ConfigT", default=Any)
NetworkT = TypeVar("NetworkT", bound=nn.Module, default=Any)
SampleT = TypeVar("SampleT", default=Any)


@dataclass(frozen=True)
class Practice:
    """How a task is trained unless one is told otherwise."""

    batch: int
    learning_rate: float  # of AdamW, at its peak
    schedule: str = "one_cycle"


def no_view() -> None:
    """Return no camera's view."""


class Result(Record):
    """What a network came to, as a frozen dataclass: in JSON and in words."""

    def lines(self) -> list[str]:
        """Return it in words: each field on a line, where a task has none of its own."""
        return [f"{name}: {value}" for name, value in self.as_json().items()]


class Evaluated(Result, ABC):
    """The task's numbers on some frames."""

    @property
    @abstractmethod
    def score(self) -> float:
        """Return the one number that training is to raise."""

    def numbers(self) -> Mapping[str, float]:
        """Return the numbers whose means over seeds a study gives, by name: the score, where a task has no others."""
        return {"score": self.score}


@dataclass(frozen=True)
class Finding:
    """What a network found in one input."""

    path: Path  # the input's own
    seen: NDArray  # picture (H, W, 3) u8, point cloud (N, 4) f32, or map: (3, H, W) bool of road, lane, crossing
    result: Result
    marks: tuple[Mark, ...] = ()  # the same, as it is drawn on what was seen
    view: Callable[[], "CameraView | None"] = no_view  # of a camera beside the LiDAR, read when asked for


class Task(Protocol[ConfigT, NetworkT, SampleT]):
    """One thing to learn from recorded frames; without parameters, whatever its configurations, networks and samples.

    A network carries its configuration as `config`, a pydantic dataclass from which `build` makes it again.
    """

    @property
    def name(self) -> str:
        """Return the task's name on the command line."""
        ...

    @property
    def family(self) -> str:
        """Return the name of the networks' architecture: files of weights are marked with it."""
        ...

    @property
    def configurations(self) -> Mapping[str, ConfigT]:
        """Return the networks one can ask for by name, the default first."""
        ...

    @property
    def practice(self) -> Practice:
        """Return how the task is trained by default."""
        ...

    def build(self, config: ConfigT) -> NetworkT:
        """Return a fresh network; torch's global generator draws its weights."""
        ...

    def samples(self, data: Dataset, config: ConfigT, frames: Sequence[int] | None = None) -> Sequence[SampleT]:
        """Return what a network of `config` learns from the frames of these numbers (None: all).

        Raises `InputError` where the dataset lacks what the task needs.
        """
        ...

    def draw(self, samples: Sequence[SampleT], index: int, config: ConfigT, rng: np.random.Generator) -> SampleT:
        """Return sample `index` as one training step sees it: augmented by what `rng` draws."""
        ...

    def loss(self, network: NetworkT, samples: Sequence[SampleT]) -> Tensor:
        """Return the loss of a batch, differentiable in the network's parameters."""
        ...

    def evaluate(
        self, network: NetworkT, data: Dataset, frames: Sequence[int] | None = None, *, progress: Report = silent
    ) -> Evaluated:
        """Return the task's numbers on frames of a dataset (None: all)."""
        ...

    def infer(
        self, network: NetworkT, path: Path, threshold: float, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield what is found in each input that `path` names, of a dataset in these frames (None: all).

        Raises `InputError` for a bad one.
        """
        ...


@runtime_checkable
class Calibrates(Protocol):
    """A task whose trained networks are told, by frames they did not learn from, how far to trust their scores."""

    def calibrate(self, network: Any, data: Dataset, frames: Sequence[int] | None = None) -> None:
        """Set the calibration in the network's configuration from frames of `data` (None: all)."""
        ...


@runtime_checkable
class Scores(Protocol):
    """A task whose findings have a score each, in [0, 1]."""

    @property
    def threshold(self) -> float:
        """Return the lowest score of what is shown and registered, unless one is told otherwise."""
        ...


@runtime_checkable
class RigBound(Protocol):
    """A task whose networks expect sensors to stand where not every agent carries them."""

    def fitting(self, data: Dataset, config: Any) -> Sequence[int]:
        """Return the frames whose sensors stand as a network of `config` expects; raises `InputError` for none."""
        ...


def configuration(task: Task[ConfigT, NetworkT, SampleT], name: str | None) -> ConfigT:
    """Return the configuration of that name, the default for None; raises `InputError` for an unknown one."""
    known = task.configurations
    if name is None:
        return next(iter(known.values()))
    if name not in known:
        raise InputError(f"network '{name}': choose one of {', '.join(known)}")
    return known[name]


def fresh(task: Task[ConfigT, NetworkT, SampleT], config: ConfigT, seed: int) -> NetworkT:
    """Return a new network, its weights drawn from `seed`."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(child_seed(seed, "weights"))
        return task.build(config)
