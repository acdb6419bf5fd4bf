"""Federated learning for the perception of connected autonomous vehicles (CAVs): simulation, planning, training.

The names here are those that most programs need; each package has further ones. A name's module is imported when the
name is first used.
"""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav import plot
    from flcav.dataset import Dataset, record, validate
    from flcav.federation import federate
    from flcav.geometry import Boxes
    from flcav.network import Ledger, StagePlan, price
    from flcav.optimization import Problem, allocate, fit, load_problem, place
    from flcav.perception import TASKS, compare, evaluate, infer, register_errors, task_named, train
    from flcav.runs import RunRecipe, load_run_recipe, run
    from flcav.sensors import Frame
    from flcav.sources import Recipe, load_recipe
    from flcav.world import Town, Trace, load_town

__version__ = "0.1.0"

PLACES = {
    "Town": "flcav.world",
    "Trace": "flcav.world",
    "load_town": "flcav.world",
    "Recipe": "flcav.sources",
    "load_recipe": "flcav.sources",
    "Frame": "flcav.sensors",
    "Boxes": "flcav.geometry",
    "Dataset": "flcav.dataset",
    "record": "flcav.dataset",
    "validate": "flcav.dataset",
    "TASKS": "flcav.perception",
    "compare": "flcav.perception",
    "evaluate": "flcav.perception",
    "infer": "flcav.perception",
    "register_errors": "flcav.perception",
    "task_named": "flcav.perception",
    "train": "flcav.perception",
    "federate": "flcav.federation",
    "Ledger": "flcav.network",
    "StagePlan": "flcav.network",
    "price": "flcav.network",
    "Problem": "flcav.optimization",
    "allocate": "flcav.optimization",
    "fit": "flcav.optimization",
    "load_problem": "flcav.optimization",
    "place": "flcav.optimization",
    "RunRecipe": "flcav.runs",
    "load_run_recipe": "flcav.runs",
    "run": "flcav.runs",
    "plot": "flcav",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
