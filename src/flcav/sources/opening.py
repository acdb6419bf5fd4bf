"""Opening of the source that a recipe names: the built-in simulator, or CARLA."""

from pathlib import Path

from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import CarlaRecipe, Recipe
from flcav.sources.source import Source


def open_source(recipe: Recipe, beside: Path | None = None) -> Source:
    """Return the source of a recipe's frames; a town's folder may be relative to `beside`, the folder of the recipe.

    Raises `InputError` where the recipe and its town do not go together, and where CARLA's client is not installed.
    """
    if isinstance(recipe, CarlaRecipe):
        from flcav.sources.carla.recording.source import CarlaSource  # not all have CARLA's client

        return CarlaSource(recipe, beside)
    return EmbeddedSource(recipe, beside)
