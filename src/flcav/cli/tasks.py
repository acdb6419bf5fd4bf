"""The tasks the command line knows."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flcav.config import InputError
from flcav.perception.device import device_named
from flcav.perception.objects.task import OBJECTS
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import Task
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import load_network, read_card, shipped

TASKS: dict[str, Task[Any, Any, Any]] = {task.name: task for task in (WEATHER, SIGNS, OBJECTS, TRAJECTORY)}


def task_named(name: str) -> Task[Any, Any, Any]:
    """Return the task; raises `InputError` for an unknown one."""
    if name not in TASKS:
        raise InputError(f"task '{name}': choose one of {', '.join(TASKS)}")
    return TASKS[name]


def network_of(task: Task[Any, Any, Any], weights: Path | None, device: str = "cpu") -> Any:
    """Return the network in the file `weights`, by default in the one that comes with the package, on the device."""
    return load_network(task, weights or shipped(task)).to(device_named(device))


def origin_of(task: Task[Any, Any, Any], weights: Path | None) -> dict[str, Any]:
    """Return which network `network_of` loads, as JSON knows it: name and seed (None without a card) and file."""
    path = weights or shipped(task)
    try:
        card = read_card(path)
    except InputError:
        return {"network": None, "seed": None, "weights": str(path)}
    return {"network": card.network, "seed": card.seed, "weights": str(path)}


def origin_line(origin: Mapping[str, Any]) -> str:
    """Return `origin_of` in words."""
    card = "without a card" if origin["network"] is None else f"{origin['network']}, seed {origin['seed']}"
    return f"network: {card}, {origin['weights']}"
