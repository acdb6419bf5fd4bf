"""Perception tasks: training, evaluation and inference of their networks, metrics, and the error registry."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.perception.client import TaskClient
    from flcav.perception.comparing import compare
    from flcav.perception.errors import PerceptionError, Registry, load_errors, save_errors
    from flcav.perception.marks import Bars, CloudBoxes, Paths, PictureBoxes
    from flcav.perception.networks import (
        Evaluation,
        Inference,
        TrainedNetwork,
        evaluate,
        infer,
        register_errors,
        train,
    )
    from flcav.perception.outcomes import NetworkComparison
    from flcav.perception.study import StudyRecipe
    from flcav.perception.task import Evaluated, Finding, Practice, Result, Task, build_network
    from flcav.perception.tasks import TASKS, task_named
    from flcav.perception.weights import from_arrays, load_network, save_network, to_arrays

PLACES = {
    "TaskClient": "flcav.perception.client",
    "PerceptionError": "flcav.perception.errors",
    "Registry": "flcav.perception.errors",
    "load_errors": "flcav.perception.errors",
    "save_errors": "flcav.perception.errors",
    "Bars": "flcav.perception.marks",
    "CloudBoxes": "flcav.perception.marks",
    "Paths": "flcav.perception.marks",
    "PictureBoxes": "flcav.perception.marks",
    "Evaluation": "flcav.perception.networks",
    "Inference": "flcav.perception.networks",
    "TrainedNetwork": "flcav.perception.networks",
    "compare": "flcav.perception.comparing",
    "evaluate": "flcav.perception.networks",
    "infer": "flcav.perception.networks",
    "register_errors": "flcav.perception.networks",
    "train": "flcav.perception.networks",
    "NetworkComparison": "flcav.perception.outcomes",
    "StudyRecipe": "flcav.perception.study",
    "Evaluated": "flcav.perception.task",
    "Finding": "flcav.perception.task",
    "Practice": "flcav.perception.task",
    "Result": "flcav.perception.task",
    "Task": "flcav.perception.task",
    "build_network": "flcav.perception.task",
    "TASKS": "flcav.perception.tasks",
    "task_named": "flcav.perception.tasks",
    "from_arrays": "flcav.perception.weights",
    "load_network": "flcav.perception.weights",
    "save_network": "flcav.perception.weights",
    "to_arrays": "flcav.perception.weights",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
