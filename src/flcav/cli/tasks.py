"""The tasks the command line knows."""

from pathlib import Path
from typing import Any

from flcav.config import InputError
from flcav.perception.objects.task import OBJECTS
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import Task
from flcav.perception.weather.task import WEATHER

TASKS: dict[str, Task[Any, Any, Any]] = {task.name: task for task in (WEATHER, SIGNS, OBJECTS)}


def task_named(name: str) -> Task[Any, Any, Any]:
    """Return the task; raises `InputError` for an unknown one."""
    if name not in TASKS:
        raise InputError(f"task '{name}': choose one of {', '.join(TASKS)}")
    return TASKS[name]


def weights_given(path: Path | None, task: str) -> Path:
    """Return the path; raises `InputError` where there is none, because no weights come with the package."""
    if path is None:
        raise InputError(f"--weights is missing: no weights for '{task}' come with the package, train some first")
    return path
