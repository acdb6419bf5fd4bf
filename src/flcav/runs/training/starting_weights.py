"""Weights that stage I of a task begins with, in place of random ones: a user's network, or that of the package."""

from pathlib import Path
from typing import Any

from flcav.config import Config, InputError, shorten
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.weights import find_shipped, load_network, to_arrays
from flcav.runs.recipe import TaskRecipe, find_path
from flcav.storage.files import sha256

SHIPPED = "shipped"  # name of the weights that come with the package


class StartingWeights(Config):
    """A file of weights from which stage I goes on."""

    path: str
    version: str  # SHA-256 of the file


def find_start(task: Task, own: TaskRecipe, beside: Path) -> StartingWeights | None:
    """Return the weights that a task begins with, None for random ones.

    Raises `InputError` where the file is not in `beside`, or its network has other arrays than the recipe's.
    """
    if own.weights is None:
        return None
    path = find_shipped(task) if own.weights == SHIPPED else find_path(own.weights, beside)
    if path is None:
        raise InputError(f"tasks.{task.name}.weights: there is no file {shorten(own.weights)} in {beside}")
    held, wanted = load_network(task, path), build_network(task, find_configuration(task, own.network), 0)
    if _shapes(held) != _shapes(wanted):
        network = own.network or next(iter(task.configurations))
        raise InputError(f"{path}: weights of another network than '{network}', which the recipe has for '{task.name}'")
    return StartingWeights(path=str(path.absolute()), version=sha256(path))


def load_start(task: Task, start: StartingWeights) -> Any:
    """Return the network to go on from; raises `InputError` where its file has changed since `find_start`."""
    path = Path(start.path)
    if sha256(path) != start.version:
        raise InputError(f"{path}: the weights were changed while the run was under way")
    return load_network(task, path)


def _shapes(network: Any) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in to_arrays(network).items()}
