"""How the arms of a run federate: checks before anything is computed, and the forms of their updates."""

from collections.abc import Iterable

from flcav.config import InputError
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.federation.stages import check_rules
from flcav.federation.strategies import Strategy, exchanges_more, of_servers, strategy_named
from flcav.federation.strategies.strategy import Corrects
from flcav.pipeline.arms import Setting
from flcav.pipeline.planning import UpdateForm
from flcav.pipeline.recipe import CLOUD, Federation, RunRecipe
from flcav.pipeline.results import TaskPlan


def find_strategies(how: Federation) -> tuple[Strategy, Strategy]:
    """Return the strategies of edge servers and of the cloud; raises `InputError` as `strategy_named` does."""
    edge = strategy_named(how.strategy)
    cloud = of_servers(edge) if how.cloud_strategy is None else strategy_named(how.cloud_strategy)
    if isinstance(cloud, Corrects):
        raise InputError(f"cloud_strategy: {type(cloud).__name__} corrects local steps, and edge servers take none")
    return edge, cloud


def check_federations(recipe: RunRecipe, settings: Iterable[Setting]) -> None:
    """Raise `InputError` where an arm's strategies and rules do not go together, or not with so many vehicles.

    The vehicles of regions of recorded data are not known before their frames are dealt.
    """
    for setting in settings:
        edge, cloud = find_strategies(setting.federation)
        for region in setting.regions:
            if recipe.regions[region].data is None:
                check_rules(edge, setting.federation, [f"{region}/cav{i}" for i in range(recipe.vehicles(region))])
        if CLOUD in setting.stages:
            check_rules(cloud, setting.federation.of_servers(), setting.regions)


def follow_plan(how: Federation, plan: TaskPlan, done: int) -> Rules:
    """Return the rules by which vehicles join the rounds that the plan gives them, after `done` rounds.

    Another selection than that of all vehicles goes before the plan's.
    """
    if plan.joins is None or how.selection.rule != "all":
        return how
    return how.model_copy(update={"selection": Selection(rule="planned", joins=plan.joins_after(done))})


def update_forms(settings: Iterable[Setting]) -> list[UpdateForm]:
    """Return the different forms of the arms' updates, in the order of the arms."""
    forms = []
    for setting in settings:
        how = setting.federation
        form = UpdateForm(upload=how.upload, exchanging=exchanges_more(how.strategy))
        if form not in forms and setting.central is None:
            forms.append(form)
    return forms
