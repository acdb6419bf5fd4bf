"""Sources of frames: the protocol, recording recipes, and the built-in simulator."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.sources.embedded import EmbeddedSource
    from flcav.sources.recipe import Recipe, load_recipe
    from flcav.sources.source import Source

PLACES = {
    "EmbeddedSource": "flcav.sources.embedded",
    "Recipe": "flcav.sources.recipe",
    "load_recipe": "flcav.sources.recipe",
    "Source": "flcav.sources.source",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
