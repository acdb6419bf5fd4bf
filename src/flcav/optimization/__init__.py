"""What to move and where to look: learning curves, allocation, placement."""

from typing import TYPE_CHECKING

from flcav.lazy import lazy_names

if TYPE_CHECKING:
    from flcav.optimization.allocation import Allocation, allocate
    from flcav.optimization.graph import load_problem
    from flcav.optimization.history import History, article_histories
    from flcav.optimization.learning_curve import Fit, fit
    from flcav.optimization.placement import Placement, place
    from flcav.optimization.problem import Budgets, Limits, Problem, Task

PLACES = {
    "Allocation": "flcav.optimization.allocation",
    "allocate": "flcav.optimization.allocation",
    "load_problem": "flcav.optimization.graph",
    "History": "flcav.optimization.history",
    "article_histories": "flcav.optimization.history",
    "Fit": "flcav.optimization.learning_curve",
    "fit": "flcav.optimization.learning_curve",
    "Placement": "flcav.optimization.placement",
    "place": "flcav.optimization.placement",
    "Budgets": "flcav.optimization.problem",
    "Limits": "flcav.optimization.problem",
    "Problem": "flcav.optimization.problem",
    "Task": "flcav.optimization.problem",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
