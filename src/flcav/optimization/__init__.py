"""Learning curves, allocation of communication budgets (MLGRA), and placement of roadside sensors (VRCSP)."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.optimization.allocation.allocate import Allocation, allocate
    from flcav.optimization.curves.fitting import Fit, fit
    from flcav.optimization.curves.history import History, article_histories
    from flcav.optimization.graph import load_problem
    from flcav.optimization.placement.place import place
    from flcav.optimization.placement.solve import Placement
    from flcav.optimization.problem import AllocationTask, Budgets, Limits, Problem

PLACES = {
    "Allocation": "flcav.optimization.allocation.allocate",
    "allocate": "flcav.optimization.allocation.allocate",
    "load_problem": "flcav.optimization.graph",
    "History": "flcav.optimization.curves.history",
    "article_histories": "flcav.optimization.curves.history",
    "Fit": "flcav.optimization.curves.fitting",
    "fit": "flcav.optimization.curves.fitting",
    "Placement": "flcav.optimization.placement.solve",
    "place": "flcav.optimization.placement.place",
    "Budgets": "flcav.optimization.problem",
    "Limits": "flcav.optimization.problem",
    "Problem": "flcav.optimization.problem",
    "AllocationTask": "flcav.optimization.problem",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
