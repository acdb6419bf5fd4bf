"""Study recipe of a task: training, validation and test recordings, and the length of the training."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from flcav.config import InputError, read_yaml
from flcav.files import Json
from flcav.sources.recipe import recipe_path

RecipeFields = Mapping[str, Json]  # fields of a recording's `Recipe`, as in YAML
SCALES = ("full", "quick")


@dataclass(frozen=True)
class StudyRecipe:
    """Recordings to train on, to choose the epoch by, and to test on; no two of them may share town and seed."""

    network: str  # name of the configuration
    train: tuple[RecipeFields, ...]
    validation: RecipeFields
    tests: Mapping[str, RecipeFields]  # by name of the test
    epochs: int
    patience: int  # epochs without a better validation score after which training stops
    quick_scenes: int = 2  # most scenes of each recording at the scale "quick"
    quick_epochs: int = 1  # epochs at the scale "quick"

    def at_scale(self, scale: str) -> "StudyRecipe":
        """Return the recipe itself ("full") or one with few scenes and epochs that runs in minutes ("quick").

        Raises `InputError` for another scale.
        """
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
    """A task with a study, which `flcav reproduce my_module:TASK` performs."""

    def study(self) -> StudyRecipe:
        """Return the recordings and the training of the study."""
        ...


def read_recipe(name: str) -> RecipeFields:
    """Return the YAML fields of one of the package's recipes without its `split`, since a study sets its own.

    Raises `InputError` for an unknown name.
    """
    fields = read_yaml(recipe_path(name))
    assert isinstance(fields, dict)
    return {field: value for field, value in fields.items() if field != "split"}
