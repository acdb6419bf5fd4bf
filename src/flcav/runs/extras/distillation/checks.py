"""Checks of labels by the road average in a recipe, and an arm's settings of them."""

from flcav.config import InputError, parse_config
from flcav.federation.strategies import Strategy
from flcav.fusion.distillation import Distillation
from flcav.fusion.pose_graph import check_gtsam
from flcav.runs.arms import Setting
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import Arm, RunRecipe


def resolve_distillation(recipe: RunRecipe, arm: Arm) -> Distillation:
    """Return the settings of label averaging of an arm: the recipe's, overridden by the arm's fields."""
    return Distillation.model_validate(_join(recipe, arm))


def _join(recipe: RunRecipe, arm: Arm) -> dict[str, object]:
    return (recipe.distillation or Distillation()).model_dump() | dict(arm.distillation)


def check_arms(recipe: RunRecipe) -> None:
    """Raise `ValueError` where an arm has fields or values that `Distillation` does not accept."""
    for name, arm in recipe.arms.items():
        try:
            parse_config(Distillation, _join(recipe, arm), f"arms.{name}.distillation")
        except InputError as error:
            raise ValueError(str(error)) from None


def check_averaged(recipe: RunRecipe, setting: Setting, strategy: Strategy) -> None:
    """Check that labels by the road average go with an arm's other settings.

    Raises `InputError` where noise or masks hide updates, since the messages for these labels are not covered; where
    imitation is asked for, since these labels have another loss; and for a pose graph without GTSAM.
    """
    how = setting.federation
    averaged = [task for task, kind in setting.labels.items() if LABEL_SOURCES[kind].averaged]
    if averaged and (how.privacy is not None or how.secure is not None):
        hidden = "secure" if how.privacy is None else "privacy"
        raise InputError(
            f"{hidden}: with the labels '{setting.labels[averaged[0]]}' of {averaged[0]} each vehicle sends boxes and "
            "poses that change what others learn from, and neither noise nor masks cover them; choose other labels"
        )
    for task in averaged:
        if setting.training[task].imitation:
            raise InputError(f"training.imitation: the labels '{setting.labels[task]}' have a loss of their own")
    if setting.distillation.pose_graph:
        check_gtsam()
