"""Arms of a run: their complete settings, and the names of their steps, which equal arms share."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from flcav.config import InputError
from flcav.federation.strategies import Strategy, of_servers, strategy_named
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import Corrects
from flcav.fusion.distillation import Distillation
from flcav.network.awareness import MessageSettings
from flcav.runs.label_sources import choose_labels
from flcav.runs.recipe import (
    CENTRAL,
    CLOUD,
    EDGE,
    MAIN,
    MORE_EDGE,
    PRETRAIN,
    Arm,
    Fault,
    Federation,
    PlacementSettings,
    RunRecipe,
    Training,
)
from flcav.runs.registry import AVERAGES, CALLS, load_all

PlanRule = Literal["joint", "equal-stages", "equal-tasks", "max-throughput"]
PLANNED = ("plan", "calls")  # fields of `Setting` that decide the plan, and the errors that sensors are placed by
PLACED = (*PLANNED, "placement")  # those that decide where sensors stand
PRETRAINED = (*PLANNED, "pretraining", "pretrain_repeat")  # those that decide pretraining
OF_ROUNDS = (  # fields of `Training` that only federations use
    "local_steps",
    "local_rate",
    "final_rate",
    "average_rounds",
    "start_share",
    "imitation",
)
LEARNED = (  # those that decide a federation
    *PLANNED,
    "training",
    "repeat",
    "placement",
    "labels",
    "messages",
    "fault",
    "distillation",
    "federation",
)
TRACKED = (*PRETRAINED, "placement", "labels", "messages")  # those that decide the vehicles' tracks
OF_EDGE = (*LEARNED[:-1], "edge_federation")  # those that decide a federation without the cloud


class CalledNumbers(NamedTuple):
    """The range from which a plan chooses the number of vehicles in a group."""

    least: int
    most: int
    overlap: float  # share of a further vehicle's data that the vehicles called before it already have


@dataclass(frozen=True)
class Setting:
    """The complete settings of one arm, including those inherited from the recipe."""

    name: str
    repeat: int  # 0: the arm itself; n: its n-th retraining
    pretrain_repeat: int  # number of its pretraining; 0 where retrainings share it
    plan: PlanRule
    calls: CalledNumbers | None  # vehicles that the plan calls to a group; None: it does not decide
    placement: PlacementSettings
    labels: Mapping[str, str]  # kind of labels, by task
    messages: MessageSettings  # where labels come from them
    fault: Fault | None  # of the labels, the rest of which are ground truth
    distillation: Distillation  # where the labels are the road average
    federation: Federation
    training: Mapping[str, Training]  # by task
    central: Literal["pretrain", "federate", "all"] | None
    uploads: int | None  # frames per region that centralised training has; None: all
    compressed: bool  # whether these are uploaded in fewer bytes
    regions: tuple[str, ...]  # that federate
    stages: tuple[str, ...]  # after pretraining
    replanned: bool  # whether the rest is planned again after stages I and II, from the scores of the run itself

    @property
    def pretraining(self) -> Mapping[str, Training]:
        """The training by task, with defaults for the fields that only federations use."""
        of_rounds = {name: field.default for name, field in Training.model_fields.items() if name in OF_ROUNDS}
        return {task: training.model_copy(update=of_rounds) for task, training in self.training.items()}

    @property
    def edge_federation(self) -> Federation:
        """The federation, with defaults for the fields that only stage III uses."""
        of_cloud = (
            "personal",
            "cloud_strategy",
            "cloud_rate",
            "cloud_start_share",
            "replay",
            "cloud_distillation",
            "score_statistics",
            "cloud_topics",
        )
        return self.federation.model_copy(update={name: Federation.model_fields[name].default for name in of_cloud})


def resolve_settings(recipe: RunRecipe, labels: Mapping[str, str] | None = None) -> dict[str, Setting]:
    """Return the settings of the run itself and of its arms by name, the run first.

    After them come those of the retrainings, named by `name_repeat`. `labels`: the run's kinds of labels by task;
    None: those of the recipe, or the task's first. Raises `InputError` for labels that a task does not have.
    """
    if labels is None:
        labels = {task: choose_labels(task, entry.labels) for task, entry in recipe.tasks.items()}
    arms = {MAIN: Arm(), **recipe.arms}
    return {
        name_repeat(name, repeat): _setting(recipe, labels, name_repeat(name, repeat), repeat, arm)
        for repeat in range(1 + recipe.retrainings)
        for name, arm in arms.items()
    }


def name_repeat(arm: str, repeat: int) -> str:
    """Return the name of an arm's n-th retraining; of the arm itself for 0."""
    return f"{arm}-again{repeat}" if repeat else arm


def _setting(recipe: RunRecipe, labels: Mapping[str, str], name: str, repeat: int, arm: Arm) -> Setting:
    learned = learns(recipe, arm.plan)
    federation = Federation.model_validate(recipe.federation.model_dump() | dict(arm.federation))
    calls = find_calls(recipe, federation) if learned else None
    return Setting(
        name,
        repeat,
        repeat if recipe.retrain_from == PRETRAIN else 0,
        arm.plan,
        calls,
        PlacementSettings.model_validate(recipe.placement.model_dump() | dict(arm.placement)),
        dict(labels) | dict(arm.labels),
        MessageSettings.model_validate(recipe.messages.model_dump() | dict(arm.messages)),
        arm.fault,
        next((resolve(recipe, arm) for resolve in load_all(AVERAGES)), Distillation()),
        federation,
        {
            task: Training.model_validate(recipe.training_of(task).model_dump() | dict(arm.training))
            for task in recipe.tasks
        },
        arm.central,
        arm.uploads,
        arm.compressed,
        arm.regions or recipe.with_role("federate"),
        (CENTRAL,) if arm.central else list_stages(recipe, arm),
        learned and recipe.replan != "none" and calls == find_calls(recipe, recipe.federation),
    )


def list_stages(recipe: RunRecipe, arm: Arm) -> tuple[str, ...]:
    """Return an arm's stages of federated learning: those it names, less cloud FL if no plan has a round of it."""
    none = all(task.plan is not None and task.plan.cloud_rounds == 0 for task in recipe.tasks.values())
    return tuple(stage for stage in arm.stages if not (none and stage == CLOUD))


def find_calls(recipe: RunRecipe, how: Federation) -> CalledNumbers | None:
    """Return the range of group sizes that a plan chooses from; None where all vehicles of a region take part."""
    return next((found for find in load_all(CALLS) if (found := find(recipe, how)) is not None), None)


def learns(recipe: RunRecipe, rule: PlanRule) -> bool:
    """Return whether `rule` optimises the plan by learning curves; other rules divide the budgets directly."""
    return rule == "joint" and any(task.history for task in recipe.tasks.values())


def find_strategies(how: Federation) -> tuple[Strategy, Strategy]:
    """Return the strategies of edge servers and of the cloud; raises `InputError` as `strategy_named` does."""
    edge = strategy_named(how.strategy)
    cloud = of_servers(edge) if how.cloud_strategy is None else strategy_named(how.cloud_strategy)
    if isinstance(cloud, Corrects):
        raise InputError(f"cloud_strategy: {type(cloud).__name__} corrects local steps, and edge servers take none")
    if isinstance(cloud, FedBuff):
        raise InputError("cloud_strategy: fedbuff does not wait for clients, and the cloud waits for all edge servers")
    if isinstance(cloud, FedMD):
        raise InputError(
            "cloud_strategy: FedMD shares frames among vehicles, and edge servers have no networks of their own"
        )
    return edge, cloud


def plans_joiners(recipe: RunRecipe, setting: Setting) -> bool:
    """Return whether a plan decides which vehicles join a round: it does where it predicts their times."""
    speeds = any(recipe.speeds(region) for region in recipe.with_role("federate"))
    timed = recipe.federation.network is not None or speeds
    return recipe.horizon_s is not None and timed and setting.central is None and learns(recipe, setting.plan)


class Names:
    """Names of a run's steps; arms that agree in all settings a step depends on share it, named after the first arm."""

    def __init__(self, settings: Mapping[str, Setting]) -> None:
        self._settings = settings

    def recording(self, region: str, split: str, task: str) -> str:
        """Return the name of the step that records a split for a task; all arms share it."""
        return f"{region}-{split}-{task}"

    def plan(self, arm: str, stage: str = PRETRAIN) -> str:
        """Return the name of the step that makes the plan by which `stage` is carried out.

        All arms with the same rule follow the plan of the first of them, so that they differ in nothing else.
        """
        before = {EDGE: PRETRAIN, CENTRAL: PRETRAIN, CLOUD: EDGE, MORE_EDGE: EDGE}.get(stage)
        replanned = self._settings[arm].replanned and before is not None
        return "plan" + (f"-after-{before}" if replanned else "") + self._suffix(arm, PLANNED)

    def pretrain(self, arm: str, task: str) -> str:
        """Return the name of the step that pretrains a task (stage I)."""
        return f"{PRETRAIN}-{task}" + self._suffix(arm, PRETRAINED)

    def errors(self, arm: str, region: str, task: str) -> str:
        """Return the name of the step that registers a task's errors in a region."""
        return f"{region}-errors-{task}" + self._suffix(arm, PLANNED)

    def remaining(self, region: str, task: str) -> str:
        """Return the name of the step that compares a region's registered errors with those after edge FL."""
        return f"{region}-errors-after-{task}"

    def place(self, arm: str, region: str) -> str:
        """Return the name of the step that places roadside sensors in a region."""
        return f"{region}-place" + self._suffix(arm, PLACED)

    def tracks(self, arm: str, region: str, task: str) -> str:
        """Return the name of the step that tracks objects around a task's training frames in a region."""
        return f"{region}-tracks-{task}" + self._suffix(arm, TRACKED, task)

    def edge(self, arm: str, region: str, task: str) -> str:
        """Return the name of stage II of a task in a region."""
        return f"{region}-{EDGE}-fl-{task}" + self._suffix(arm, OF_EDGE, task)

    def more_edge(self, arm: str, region: str, task: str) -> str:
        """Return the name of the step with further edge rounds of a task in a region."""
        return f"{region}-more-{EDGE}-fl-{task}" + self._suffix(arm, OF_EDGE, task)

    def cloud(self, arm: str, task: str) -> str:
        """Return the name of stage III of a task."""
        return f"{CLOUD}-fl-{task}" + self._suffix(arm, LEARNED, task)

    def central(self, arm: str, region: str, task: str) -> str:
        """Return the name of an arm's centralised training; all regions share it unless it uses their frames."""
        shared = self._settings[arm].central != "federate"
        return f"{CENTRAL}-{task}-{arm}" if shared else f"{region}-{CENTRAL}-{task}-{arm}"

    def stage(self, arm: str, stage: str, region: str, task: str) -> str:
        """Return the name of the step that trained an arm's network for a region in a stage."""
        if stage == PRETRAIN:
            return self.pretrain(arm, task)
        if stage == CLOUD:
            return self.cloud(arm, task)
        return {EDGE: self.edge, MORE_EDGE: self.more_edge, CENTRAL: self.central}[stage](arm, region, task)

    def test(self, trained: str, region: str, model: str | None = None) -> str:
        """Return the name of the test of a step's network in a region, or of the personal model of region `model`."""
        return f"test-{trained}-{region}" if model is None else f"test-{trained}-of-{model}-{region}"

    def rounds(self, trained: str, region: str) -> str:
        """Return the name of the step that validates a step's network in a region after every round."""
        return f"rounds-{trained}-{region}"

    def _suffix(self, arm: str, fields: tuple[str, ...], task: str | None = None) -> str:
        values = self._rests_on(arm, fields, task)
        first = next(name for name in self._settings if self._rests_on(name, fields, task) == values)
        return "" if first == MAIN else f"-{first}"

    def _rests_on(self, arm: str, fields: tuple[str, ...], task: str | None) -> list[object]:
        """Return the values of the settings that a step depends on; of the labels only those of `task`."""
        setting = self._settings[arm]
        values = {name: getattr(setting, name) for name in fields}
        if task is not None:
            values["labels"] = setting.labels[task]
        return list(values.values())


def name_steps(recipe: RunRecipe) -> Names:
    """Return the names of a recipe's steps, whose folders lie in the folder `work` of its run."""
    return Names(resolve_settings(recipe))
