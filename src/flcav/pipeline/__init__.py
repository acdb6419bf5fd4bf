"""Runs of the three-stage federated learning system: `run` carries out a `RunRecipe` and returns a `Run`."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.pipeline.comparing import Compared, compare
    from flcav.pipeline.forecast import Forecast, forecast_run
    from flcav.pipeline.recipe import RunRecipe, load_run_recipe
    from flcav.pipeline.results.run import Run, Summary
    from flcav.pipeline.running import run, run_seeds

PLACES = {
    "Compared": "flcav.pipeline.comparing",
    "Forecast": "flcav.pipeline.forecast",
    "Run": "flcav.pipeline.results.run",
    "RunRecipe": "flcav.pipeline.recipe",
    "Summary": "flcav.pipeline.results.run",
    "compare": "flcav.pipeline.comparing",
    "forecast_run": "flcav.pipeline.forecast",
    "load_run_recipe": "flcav.pipeline.recipe",
    "run": "flcav.pipeline.running",
    "run_seeds": "flcav.pipeline.running",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
