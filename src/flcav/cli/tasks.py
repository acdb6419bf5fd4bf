"""The tasks the command line knows, and recorded frames as their samples."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.perception.objects.task import ObjectsTask
from flcav.perception.task import Task

TASKS: dict[str, Task[Any, Any]] = {"objects": ObjectsTask()}


def task_named(name: str) -> Task[Any, Any]:
    """Return the task; raises `InputError` for an unknown one."""
    if name not in TASKS:
        raise InputError(f"task '{name}': choose one of {', '.join(TASKS)}")
    return TASKS[name]


def weights_given(path: Path | None, task: str) -> Path:
    """Return the path; raises `InputError` where there is none, because no weights come with the package."""
    if path is None:
        raise InputError(f"--weights is missing: no weights for '{task}' come with the package, train some first")
    return path


class DatasetSamples(Sequence[Any]):
    """The frames of datasets as samples of a task, read when asked for."""

    def __init__(self, datasets: Sequence[Dataset], task: Task[Any, Any], network: Any) -> None:
        self._frames = [(dataset, i) for dataset in datasets for i in range(len(dataset))]
        self._task, self._network = task, network

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        dataset, i = self._frames[index]
        return self._task.sample(dataset.frame(i), self._network)
