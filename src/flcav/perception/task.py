"""What a perception task is: how to make its network, its samples, its training and its measure."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from flcav.progress import Report
from flcav.sensors.frame import Frame

NetworkT = TypeVar("NetworkT")
SampleT = TypeVar("SampleT")


class Task(Protocol[NetworkT, SampleT]):
    """One thing to learn from frames. The command line and the experiments work with any of them."""

    name: str

    def network(self, variant: str, seed: int) -> NetworkT:
        """Return a fresh network; raises `InputError` for an unknown variant."""
        ...

    def load(self, path: Path) -> NetworkT:
        """Return the network saved at `path`; raises `InputError` where the file is of another one."""
        ...

    def save(self, network: NetworkT, path: Path) -> None:
        """Write the network so that `load` returns it."""
        ...

    def sample(self, frame: Frame, network: NetworkT) -> SampleT:
        """Return the frame as the network learns from it."""
        ...

    def train(
        self,
        network: NetworkT,
        samples: Sequence[SampleT],
        *,
        epochs: int,
        seed: int,
        checkpoint: Path,
        progress: Report,
    ) -> float:
        """Train in place, going on from `checkpoint` if it exists; return the mean loss of the last epoch."""
        ...

    def evaluate(self, network: NetworkT, frames: Iterable[Frame], *, total: int, progress: Report) -> dict[str, Any]:
        """Return the task's numbers on `frames`, as JSON knows them."""
        ...

    def infer(self, network: NetworkT, path: Path, threshold: float) -> list[dict[str, Any]]:
        """Return one entry {"path": ..., ...} per input that `path` names; raises `InputError` for a bad one."""
        ...
