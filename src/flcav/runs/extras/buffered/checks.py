"""Checks of buffered rounds in a recipe."""

from flcav.config import InputError
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.runs.arms import Setting, plans_joiners
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import RunRecipe


def check_buffers(recipe: RunRecipe, setting: Setting, strategy: Strategy) -> None:
    """Raise `InputError` where an arm's rounds are buffers, and no clock is theirs, or something goes by rounds."""
    if not isinstance(strategy, FedBuff):
        return
    if setting.federation.network is None:
        raise InputError("strategy fedbuff: vehicles go on at their own pace, by the clock of 'federation.network'")
    if plans_joiners(recipe, setting):
        raise InputError("strategy fedbuff: nobody joins rounds by a plan; leave out horizon_s")
    if any(LABEL_SOURCES[kind].averaged for kind in setting.labels.values()):
        raise InputError("strategy fedbuff: labels 'road-average' are made anew before a round that all begin together")
