"""Checks of groups on request in a recipe, and the numbers of vehicles that a plan may call."""

from flcav.config import InputError
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import needs_known_number
from flcav.runs.arms import CalledNumbers, Setting, plans_joiners
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import Federation, RunRecipe


def count_called(recipe: RunRecipe, how: Federation) -> CalledNumbers | None:
    """Return the range from which a plan chooses the size of a group on request; None for a fixed roster."""
    if how.requests is None:
        return None
    most = how.requests.most or max(map(recipe.vehicles, recipe.with_role("federate")))
    return CalledNumbers(1, most, how.requests.overlap)


def check_groups(recipe: RunRecipe, setting: Setting, strategy: Strategy) -> None:
    """Raise `InputError` where an arm has groups on request that conflict with its other settings."""
    if setting.federation.requests is not None:
        check_roster(recipe, setting, strategy)


def check_roster(recipe: RunRecipe, setting: Setting, strategy: Strategy) -> None:
    """Raise `InputError` where a strategy, rules or labels conflict with groups, whose size is not known before."""
    how = setting.federation
    reason = "requests: how many vehicles a group has is not known before"
    if isinstance(strategy, FedBuff | FedMD) or needs_known_number(strategy):
        raise InputError(f"{reason}, and {type(strategy).__name__} needs a known roster")
    if how.selection.rule != "all" or how.least_clients is not None or how.secure is not None:
        raise InputError(f"{reason}; leave out 'selection', 'least_clients' and 'secure'")
    if how.privacy is not None:
        raise InputError("privacy: requests and offers tell of a vehicle's data, and no noise covers them")
    if plans_joiners(recipe, setting):
        raise InputError("requests: nobody joins rounds by a plan; leave out horizon_s")
    if how.requests is not None and how.requests.roadside:
        for task, kind in setting.labels.items():
            if not LABEL_SOURCES[kind].trained or LABEL_SOURCES[kind].averaged:
                raise InputError(
                    f"requests.roadside: units label by their trained detector, and the labels of '{task}' are "
                    f"'{kind}'; choose 'road' or 'road+tracks'"
                )
    if any(LABEL_SOURCES[kind].averaged for kind in setting.labels.values()):
        raise InputError("requests: vehicles check the network by labels of their own, not by those of 'road-average'")
