"""Checks of lifelong learning in a recipe."""

from flcav.config import InputError, parse_config
from flcav.federation.strategies import Strategy
from flcav.runs.arms import Setting
from flcav.runs.extras.groups.checks import check_roster
from flcav.runs.extras.groups.settings import Requests
from flcav.runs.recipe import MAIN, RunRecipe


def check_lifelong(recipe: RunRecipe) -> None:
    """Raise `ValueError` where a recipe's conditions do not federate, or its groups cannot send requests."""
    lifelong = recipe.lifelong
    if lifelong is None:
        return
    federating = recipe.with_role("federate")
    if odd := [region for region in lifelong.conditions if region not in federating]:
        raise ValueError(f"lifelong.conditions: '{odd[0]}' is none of {', '.join(federating)}")
    if not all(task.pretrains for task in recipe.tasks.values()):
        raise ValueError("lifelong: vehicles ask by the loss at the end of pretraining, and a plan has none")
    try:
        find_requests(recipe)
    except InputError as error:
        raise ValueError(str(error)) from None


def find_requests(recipe: RunRecipe) -> Requests:
    """Return the settings of lifelong learning's groups: the recipe's or the defaults, overridden by its fields."""
    given = {} if recipe.lifelong is None else dict(recipe.lifelong.requests)
    whole = (recipe.federation.requests or Requests()).model_dump() | given
    return parse_config(Requests, whole, "lifelong.requests")


def check_conditions(recipe: RunRecipe, setting: Setting, strategy: Strategy) -> None:
    """Raise `InputError` where the federation of the run itself does not suit groups, which learn in the conditions."""
    if recipe.lifelong is not None and setting.name == MAIN:
        check_roster(recipe, setting, strategy)
