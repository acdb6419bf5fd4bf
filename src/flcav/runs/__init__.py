"""Runs of the three-stage federated learning system: `run` carries out a `RunRecipe` and returns a `Run`."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.runs.comparing import Compared, compare
    from flcav.runs.forecast import Forecast, forecast_run
    from flcav.runs.recipe import RunRecipe, load_run_recipe
    from flcav.runs.results.run import Run, Summary
    from flcav.runs.running import run, run_seeds

PLACES = {
    "Compared": "flcav.runs.comparing",
    "Forecast": "flcav.runs.forecast",
    "Run": "flcav.runs.results.run",
    "RunRecipe": "flcav.runs.recipe",
    "Summary": "flcav.runs.results.run",
    "compare": "flcav.runs.comparing",
    "forecast_run": "flcav.runs.forecast",
    "load_run_recipe": "flcav.runs.recipe",
    "run": "flcav.runs.running",
    "run_seeds": "flcav.runs.running",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
