"""Checks of a run's arms: strategies, rules, labels and numbers of vehicles that go together."""

from collections.abc import Iterable, Sequence

from flcav.config import InputError
from flcav.federation.checks import check_rules
from flcav.federation.privacy import affordable_rounds, find_noise
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import needs_known_number
from flcav.federation.trainable import statistics_names
from flcav.network.awareness import MessageSettings
from flcav.perception.client import Compresses, Imitates
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network, find_configuration
from flcav.perception.tasks import TASKS, task_named
from flcav.perception.weights import to_arrays
from flcav.runs.arms import Setting, find_strategies, learns, plans_joiners
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import CLOUD, MAIN, RunRecipe
from flcav.runs.registry import ARM_CHECKS, load_all


def check_federations(recipe: RunRecipe, settings: Iterable[Setting]) -> None:
    """Check that the strategies and rules of all arms go together, and suit the number of vehicles.

    Raises `InputError` where they do not, where a pose graph is asked for without GTSAM, and for a horizon without a
    plan to limit. Regions of recorded data are left out: their vehicles are not known before their frames are dealt.
    """
    settings = [*settings]
    if recipe.horizon_s is not None and not any(learns(recipe, setting.plan) for setting in settings):
        raise InputError(
            "horizon_s: every task has a fixed plan, so that nothing is planned by time; give a task a 'history' in "
            "place of its 'plan', or leave horizon_s out and have rounds timed by 'federation.network'"
        )
    _check_messages(recipe, settings)
    for setting in settings:
        try:
            _check_federation(recipe, setting)
        except InputError as error:
            if setting.name == MAIN:
                raise
            raise InputError(f"arm '{setting.name}': {error}") from None


def _check_messages(recipe: RunRecipe, settings: Sequence[Setting]) -> None:
    """Raise `InputError` where messages are described and no labels come from them."""
    hear = {each.name for each in settings if any(LABEL_SOURCES[kind].heard for kind in each.labels.values())}
    given = [f"arms.{name}.messages" for name, arm in recipe.arms.items() if arm.messages and name not in hear]
    if not hear and recipe.messages.model_dump() != MessageSettings().model_dump():
        given.append("messages")
    if given:
        raise InputError(f"{given[0]}: its labels are without messages; choose 'tracks+messages' or leave it out")


def _check_federation(recipe: RunRecipe, setting: Setting) -> None:
    how = setting.federation
    edge, cloud = find_strategies(how)
    selection = how.selection
    privacy = how.privacy
    for check in load_all(ARM_CHECKS) if setting.central is None else ():
        check(recipe, setting, edge)
    if how.network is not None and selection.rule == "importance":
        raise InputError("federation.network: importance selection draws the clients after they have trained")
    if how.network is not None and selection.unbiased:
        raise InputError("federation.network: unbiased weights need known probabilities, and the radio loses any")
    if how.network is not None and privacy is not None and privacy.hides_draws(selection):
        raise InputError(
            f"federation.network: rounds are timed before they are run, and {selection.rule} selection under "
            "central noise draws in secret; 'privacy.seeded' simulates both"
        )
    if how.replay and (how.personal or isinstance(edge, FedMD)):
        raise InputError("federation.replay: the cloud's own training goes with whole networks, not personal or fedmd")
    if how.replay and how.cloud_topics:
        raise InputError("federation.replay: the cloud's own training, which no topic is for; leave out 'cloud_topics'")
    if setting.fault is not None and not all(LABEL_SOURCES[kind].tracked for kind in setting.labels.values()):
        raise InputError(f"fault: '{setting.fault}' is one of labels by tracks; choose 'tracks' or 'road+tracks'")
    _check_distillation(setting, edge, cloud)
    _check_roadside(setting)
    _check_imitation(setting)
    if setting.compressed and (bare := [task for task in recipe.tasks if not isinstance(task_named(task), Compresses)]):
        raise InputError(f"compressed: it is a form of sweeps, and '{bare[0]}' uploads none; leave it out")
    _check_numbers(recipe, setting, edge)
    if isinstance(edge, FedMD) and setting.central is None:
        _check_outputs(recipe, setting)
    for region in setting.regions:
        if recipe.regions[region].data is None:
            names = [f"{region}/cav{i}" for i in range(recipe.vehicles(region))]
            check_rules(edge, how, names)
            if privacy is not None:
                affordable_rounds(find_noise(privacy, selection, len(names), 1), selection, names, 1, 0)
    if CLOUD in setting.stages:
        try:
            check_rules(cloud, how.of_servers(), setting.regions)
        except InputError as error:
            given = "" if how.cloud_strategy else " (that of 'strategy', as none is given)"
            raise InputError(f"cloud_strategy{given}, among edge servers: {error}") from None
    for task in recipe.tasks if how.personal or how.upload.layers or how.score_statistics else ():
        _check_arrays(task, recipe.tasks[task].network, setting)


def _check_distillation(setting: Setting, edge: Strategy, cloud: Strategy) -> None:
    """Raise `InputError` where the regions' networks cannot teach the cloud's average."""
    how = setting.federation
    if how.cloud_distillation is None:
        return
    field = "federation.cloud_distillation"
    if how.personal or how.upload.layers or isinstance(edge, FedMD):
        raise InputError(f"{field}: whole networks teach; leave out 'personal', 'upload.layers' and fedmd")
    if type(cloud) is not FedAvg:
        raise InputError(f"{field}: it teaches the mean of fedavg, not of the strategy {type(cloud).__name__}")
    for task in setting.training:
        if task != OBJECTS.name:
            raise InputError(f"{field}: detectors teach by scores, and '{task}' has none; leave 'objects' alone")


def _check_roadside(setting: Setting) -> None:
    """Raise `InputError` where roadside units shall train and have no detector's boxes to learn from."""
    for task, kind in setting.labels.items() if setting.federation.roadside_clients else ():
        source, field = LABEL_SOURCES[kind], "federation.roadside_clients"
        if not (source.from_poles and source.trained and setting.placement.count):
            raise InputError(f"{field}: labels '{kind}' of '{task}' have no boxes of roadside units")
        if source.averaged:
            raise InputError(f"{field}: labels '{kind}' of '{task}' are made for vehicles alone; choose road+tracks")


def _check_imitation(setting: Setting) -> None:
    """Raise `InputError` where an arm imitates the boxes of a task other than object detection."""
    for task, training in setting.training.items():
        if training.imitation and task != OBJECTS.name:
            raise InputError(f"training.imitation: it keeps boxes, and '{task}' has none; give it to 'objects' alone")


def _check_numbers(recipe: RunRecipe, setting: Setting, strategy: Strategy) -> None:
    """Raise `InputError` where an arm needs a known number of vehicles in a round, and its rounds may have any.

    Under a predicted deadline the numbers are known only when a region's rounds are timed, after its recordings and
    pretraining. Raises it also for a deadline without a network to predict round times.
    """
    how = setting.federation
    predicted = how.selection.predicts
    if predicted and how.network is None:
        raise InputError(
            "selection: a deadline needs the predicted 'seconds' of a round by client, or a federation.network"
        )
    if predicted:
        why = "federation.network: a predicted deadline leaves other numbers of vehicles to its rounds"
        instead = ""
    elif how.selection.rule == "all" and plans_joiners(recipe, setting):
        why = "horizon_s: a plan by speeds or the time of messages leaves other numbers of vehicles to its rounds"
        instead = "; choose another 'selection' than all, or leave out horizon_s"
        if how.secure is not None:
            raise InputError(f"{why}, some of them one, and secure aggregation takes two or more{instead}")
    else:
        return
    if how.privacy is not None:
        raise InputError(f"{why}, and noise is for one number{instead}")
    if needs_known_number(strategy):
        raise InputError(f"{why}, and {type(strategy).__name__} needs a known one{instead}")


def _check_outputs(recipe: RunRecipe, setting: Setting) -> None:
    """Raise `InputError` where vehicles cannot send class probabilities: tasks without them, or a radio network."""
    for name in recipe.tasks:
        if not isinstance(task_named(name), Imitates):
            fit = " and ".join(task for task in TASKS if isinstance(task_named(task), Imitates))
            raise InputError(f"strategy fedmd: '{name}' has no class probabilities of shared frames; {fit} have")
    if setting.federation.network is not None:
        raise InputError("federation.network: its clock knows updates of weights alone, and fedmd sends probabilities")


def _check_arrays(task: str, network: str | None, setting: Setting) -> None:
    """Raise `InputError` where the recipe's patterns of names match no arrays of a task's network."""
    learned = task_named(task)
    weights = to_arrays(build_network(learned, find_configuration(learned, network), 0))
    if setting.federation.upload.layers:
        setting.federation.upload.check_layers(weights)
    if CLOUD in setting.stages:
        setting.federation.check_personal(weights)
        if setting.federation.score_statistics and not statistics_names(weights):
            raise InputError(f"federation.score_statistics: the network of {task} has no batch normalisation")
