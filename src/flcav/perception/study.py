"""Study recipe of a task: training, validation and test recordings, and the length of the training.

All seeds of a study share the recordings for training and validation; the test recordings differ by seed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from flcav.config import InputError, Json, read_yaml
from flcav.sources.recipe import recipe_path

RecipeFields = Mapping[str, Json]  # fields of a recording's `Recipe`, as in YAML
SCALES = ("full", "quick")
TEST_SEEDS = 10_000  # distance between the seeds of test recordings of consecutive study seeds


@dataclass(frozen=True)
class StudyRecipe:
    """Recordings to train on, to choose the epoch by, and to test on.

    No two of them may share town and seed; seeds are below `TEST_SEEDS`.
    """

    network: str  # name of the configuration
    train: tuple[RecipeFields, ...]
    validation: RecipeFields
    tests: Mapping[str, RecipeFields]  # by name of the test; recorded anew for each seed of the study: `tests_of`
    epochs: int
    patience: int  # epochs without a better validation score after which training stops
    quick_scenes: int = 2  # most scenes of each recording at the scale "quick"
    quick_epochs: int = 1  # epochs at the scale "quick"

    def tests_of(self, seed: int) -> Mapping[str, RecipeFields]:
        """Return the test recordings for a seed of the study, by name: traffic and weather are redrawn."""
        return {name: {**fields, "seed": test_seed(fields, seed)} for name, fields in self.tests.items()}

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


def test_seed(recipe: RecipeFields, seed: int) -> int:
    """Return the seed of the test recording by `recipe` for a seed of the study."""
    first = recipe.get("seed", 0)
    assert isinstance(first, int)
    return first + TEST_SEEDS * seed


@runtime_checkable
class Studied(Protocol):
    """A task with a study, which `flcav reproduce my_module:TASK` performs."""

    def study(self) -> StudyRecipe:
        """Return the recordings and the training of the study."""
        ...


def read_recipe(name: str) -> RecipeFields:
    """Return the YAML fields of one of the package's recipes without its `split`, which a study sets.

    Raises `InputError` for an unknown name.
    """
    fields = read_yaml(recipe_path(name))
    assert isinstance(fields, dict)
    return {field: value for field, value in fields.items() if field != "split"}
