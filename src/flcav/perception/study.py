"""The study of a task: what is recorded to learn from and to be tested on, and how long is trained."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from flcav.config import InputError, read_yaml
from flcav.files import Json
from flcav.sources.recipe import recipe_path

RecipeFields = Mapping[str, Json]  # of a `Recipe`, as YAML has it
SCALES = ("full", "quick")


@dataclass(frozen=True)
class StudyRecipe:
    """Frames to learn from, to choose the epoch by, and to test once; no two of them may share town and seed."""

    network: str  # name of the configuration
    train: tuple[RecipeFields, ...]
    validation: RecipeFields
    tests: Mapping[str, RecipeFields]  # by name
    epochs: int
    patience: int
    quick_scenes: int = 2  # of every recipe at the quick scale
    quick_epochs: int = 1

    def at_scale(self, scale: str) -> "StudyRecipe":
        """Return it as it stands ("full") or to run in minutes ("quick"); raises `InputError` for another scale."""
        if scale not in SCALES:
            raise InputError(f"scale '{scale}': a task's study knows {' and '.join(SCALES)}")
        if scale == "full":
            return self

        def few(recipe: RecipeFields) -> RecipeFields:
            scenes = recipe.get("scenes", 1)
            assert isinstance(scenes, int)
            return {**recipe, "scenes": min(scenes, self.quick_scenes)}

        return replace(
            self,
            train=tuple(few(recipe) for recipe in self.train),
            validation=few(self.validation),
            tests={name: few(recipe) for name, recipe in self.tests.items()},
            epochs=self.quick_epochs,
        )


@runtime_checkable
class Studied(Protocol):
    """A task that says how it is studied: `flcav reproduce my_module:TASK` does so."""

    def study(self) -> StudyRecipe:
        """Return what is recorded, trained and tested."""
        ...


def read_recipe(name: str) -> RecipeFields:
    """Return the fields of a recipe that comes with flcav as YAML has them, without its split: a study has its own.

    Raises `InputError` for an unknown name.
    """
    fields = read_yaml(recipe_path(name))
    assert isinstance(fields, dict)
    return {field: value for field, value in fields.items() if field != "split"}
