"""The schema of a run recipe: tasks, regions, uplink budgets, sensor placement, federation, sizes, and arms to compare.

`find_path` is where the files that it names are looked for.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, field_validator, model_validator

from flcav.config import Config, InputError, parse_config, read_yaml
from flcav.federation.links.ros_names import ROS_NAMESPACE
from flcav.federation.local_steps import MEASURED, fit_local_steps
from flcav.federation.rules import Rules
from flcav.fusion.average import NavigationErrors, PoseSource
from flcav.interface.notebook import Displayed
from flcav.network.awareness import MessageSettings
from flcav.network.clock.rounds import NetworkSettings
from flcav.optimization.problem import Budgets
from flcav.runs.recipe.splits import (
    SIZES,
    SPLITS_OF,
    Count,
    Positive,
    Recording,
    Region,
    Role,
    Split,
    SplitName,
    Splits,
    Training,
)
from flcav.runs.registry import RECIPE_CHECKS, ArmFields, FederationFields, LabelFields, RecipeFields, load_all
from flcav.statistics.streams import stream

MAIN = "main"  # the arm that the recipe itself describes
PRETRAIN, EDGE, CLOUD, CENTRAL = "pretrain", "edge", "cloud", "central"
ALL = "all"  # regions that centralised training is on
TRACKING = "tracking"  # of the objects around training frames, for labels of stages II and III
ELSEWHERE = "elsewhere"  # the claim that federated learning helps in regions that do not federate
MORE_EDGE = "more_edge"  # after stage II: as many further edge rounds as stage III has, without the cloud

Fault = Literal[  # see `flcav.runs.labels.faults`
    "missed", "unsure", "range", "occlusion", "false", "boxes", "presence"
]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_]*$")]
RosNamespace = Annotated[str, Field(pattern=ROS_NAMESPACE)]


class Stragglers(Config):
    """Share of each federating region's vehicles that train slower, and by what factor."""

    share: float = Field(gt=0, le=1)  # of the vehicles, rounded to whole ones
    slower: float = Field(gt=1, le=1000)  # times as long as a vehicle of speed 1


def draw_stragglers(how: Stragglers, vehicles: Sequence[str], seed: int, region: str) -> dict[str, float]:
    """Draw the stragglers among a region's vehicles; return their relative speeds by vehicle; others have 1."""
    drawn: list[int] = stream(seed, "stragglers", region).permutation(len(vehicles)).tolist()
    return {vehicles[number]: 1 / how.slower for number in sorted(drawn[: round(how.share * len(vehicles))])}


class FixedPlan(Config):
    """A task's plan, given by hand instead of computed."""

    samples: Count  # samples uploaded for pretraining; 0: none, and the network stays that of `weights`
    edge_rounds: Count  # rounds of edge FL
    cloud_rounds: Count  # rounds of cloud FL


class TaskRecipe(Config):
    """Settings of one perception task in a run."""

    network: str | None = None  # name of a network configuration; default: the task's first
    weights: str | None = (
        None  # file of weights of this network, from which training goes on; packaged, or shipped: those of the package
    )
    weight: Positive = 1.0  # weight of the task's error in the plan's objective
    labels: str | None = None  # kind of labels in stages II and III; default: the task's first
    train_s: float = Field(default=0.0, ge=0)  # time that a vehicle trains in one round [s], for `horizon_s`
    history: str | None = None  # history of the learning curve: a name of the package, or a CSV file
    plan: FixedPlan | None = None  # a plan given by hand, instead of a history
    recording: Recording = Recording()  # changes to how the task is recorded
    training: Training | None = None  # training schedule; default: the run's

    @property
    def pretrains(self) -> bool:
        """Return whether stage I trains: it does unless the plan has no samples for it."""
        return self.plan is None or self.plan.samples > 0

    @model_validator(mode="after")
    def _begins_with_a_network(self) -> Self:
        if not self.pretrains and self.weights is None:
            raise ValueError("a plan of 0 samples trains nothing in stage I: name the 'weights' to begin with")
        return self


class PlanLimits(Config):
    """Bounds (least, most) of a plan's decision variables."""

    samples: tuple[Count, Count | None] = (40, None)  # of pretraining; None: all that the pools hold
    edge_rounds: tuple[Count, Count | None] = (1, None)  # of edge FL; None: as many as the history has
    cloud_rounds: tuple[Count, Count | None] = (1, None)  # of cloud FL; None: as many as the history has


class PlacementSettings(Config):
    """Settings of the choice of sites for roadside sensors."""

    rule: Literal["vrcsp", "densest", "random", "fixed", "none"] = (
        "vrcsp"  # vrcsp: covers most errors; densest: most traffic; random; fixed: those in `poles`; none: no sensors
    )
    poles: tuple[int, ...] = ()  # numbers of the poles that have a sensor, of the rule `fixed`
    count: int = Field(default=1, ge=1, le=100)  # sensors per region, of the other rules
    range_m: float = Field(default=40.0, gt=0, le=1000)  # radius within which a sensor covers an error
    group_range_m: float = Field(
        default=60.0, gt=0, le=10_000
    )  # vehicles train on frames recorded within this distance of a sensor of any arm
    tasks: tuple[str, ...] = ()  # tasks whose errors are to be covered; default: objects, if the run has it

    @model_validator(mode="after")
    def _fixed_or_chosen(self) -> Self:
        if (self.rule == "fixed") != bool(self.poles):
            raise ValueError("'poles' and the rule 'fixed' belong together")
        if len(set(self.poles)) < len(self.poles):
            raise ValueError("'poles': one of them is named twice")
        return self


StrategySpec = str | Mapping[str, Mapping[str, Any]]  # a name, or a name with settings


class CloudDistillation(Config):
    """Ensemble distillation in the cloud: after each average the regions' networks teach it, see `TaughtObjects`."""

    steps: int = Field(default=24, ge=1, le=10**6)  # optimiser steps after each average, on the samples of stage I
    weight: float = Field(default=1.0, ge=0)  # of the ensemble's scores, beside the loss on labels


class _Strategies(Rules):
    """Strategies, and the rules of the vehicles' rounds."""

    strategy: StrategySpec = "fedavg"  # name, or {name: settings}; module:NAME of your own
    cloud_strategy: StrategySpec | None = (
        None  # of the cloud; default: `strategy`, or fedavg where that corrects local steps, is fedmd or fedbuff
    )
    edge_rounds_per_cloud_round: int = Field(default=1, ge=1, le=100)  # in every region
    cloud_rate: float | None = Field(
        default=None, gt=0
    )  # learning rate of the first cloud round; default: `final_rate`
    cloud_start_share: float = Field(default=0.0, ge=0, lt=1)  # of the pretrained weights in the result of stage III
    replay: float = Field(
        default=0.0, ge=0, lt=1
    )  # weight in the cloud's averages of its own training on the samples of stage I, which it has
    cloud_distillation: CloudDistillation | None = None  # of stage III's averages; None: they stay as they are
    roadside_clients: bool = False  # whether roadside units train, too, wired to their edge server
    score_statistics: bool = False  # validate stage III also with each region's own statistics of batch normalisation
    network: NetworkSettings | None = None  # radio, wireline and rules of rounds; default: every message arrives


class Federation(FederationFields, _Strategies):
    """Settings of federated learning: strategies, the rules of the vehicles' rounds, and those of extras."""

    cloud_topics: RosNamespace | None = None  # edge servers and cloud exchange parameters by ROS 2 topics below it

    @property
    def trains_in_cloud(self) -> bool:
        """Whether the cloud trains on the samples of stage I, by replay or ensemble distillation."""
        return bool(self.replay) or self.cloud_distillation is not None


def _name_replanning(value: Any) -> Any:
    if value == "rounds":
        raise ValueError("plans are updated between stages, not between rounds: write 'stages'")
    return ("stages" if value else "none") if isinstance(value, bool) else value


Replanning = Annotated[Literal["none", "stages"], BeforeValidator(_name_replanning)]


class _PlannedArm(Config):
    """Changes of an arm to the plan, placement, federation and labels of the run."""

    plan: Literal["joint", "equal-stages", "equal-tasks", "max-throughput"] = (
        "joint"  # joint: optimal under both budgets; otherwise a baseline
    )
    placement: Mapping[str, Any] = {}  # fields of `PlacementSettings` that differ from the run
    federation: Mapping[str, Any] = {}  # fields of `Federation` that differ from the run
    labels: Mapping[str, str] = {}  # kinds of labels that differ from the run, by task
    messages: Mapping[str, Any] = {}  # fields of `MessageSettings` that differ from the run
    fault: Fault | None = None  # learn from ground truth with this one fault of the labels, which come from tracks


class Arm(ArmFields, _PlannedArm):
    """An arm of a comparison: how it differs from the run itself, and which stages it runs."""

    training: Mapping[str, Any] = {}  # fields of `Training` that differ from the run, for every task
    central: Literal["pretrain", "federate", "all"] | None = (
        None  # train centrally on the ground truth of the regions of this role; all: one network on that of both
    )
    uploads: int | None = Field(
        default=None, ge=1
    )  # with `central: federate`: train on so many frames that vehicles upload with their annotations; None: on all
    compressed: bool = False  # with `uploads`: sweeps are sent in levels of a centimetre, delta-coded, not as floats
    stages: tuple[Literal["edge", "cloud", "more_edge"], ...] = (
        "edge",
        "cloud",
    )  # stages of federated learning to run; more_edge: further edge rounds instead of the cloud rounds
    regions: tuple[str, ...] | None = None  # federating regions that take part; default: all

    @model_validator(mode="after")
    def _uploads_are_learned_from(self) -> "Arm":
        if self.uploads is not None and self.central != "federate":
            raise ValueError("uploads: of centralised training alone; it goes with 'central: federate'")
        if self.compressed and self.uploads is None:
            raise ValueError("compressed: it is a form of uploads; give their number in 'uploads'")
        return self

    @field_validator("stages")
    @classmethod
    def _from_the_first(cls, stages: tuple[str, ...]) -> tuple[str, ...]:
        if stages not in ((EDGE,), (EDGE, CLOUD), (EDGE, MORE_EDGE)):
            raise ValueError("must be [edge], [edge, cloud] or [edge, more_edge]")
        return stages


class _Scene(Config):
    """Tasks, regions, budgets and rules of a run."""

    seed: int = Field(default=1, ge=0, lt=2**31)  # of all random draws
    retrainings: int = Field(default=0, ge=0, le=100)  # of every arm, on the same frames with other random numbers
    retrain_from: Literal["pretrain", "edge"] = (
        "pretrain"  # first stage that retrainings repeat; edge: all go on from one pretrained network
    )
    spread: str | None = None  # spread of retraining of a run without: a name of the package's, or a CSV file
    test_draw: int = Field(default=0, ge=0)  # draw of the test scenes; another one after results were looked at
    size: Literal["toy", "demo", "full"] = "demo"  # preset of `splits` and `training` where they are not given
    splits: Splits | None = None  # sizes of the data splits; default: by `size`
    training: Training | None = None  # training schedule; default: by `size`
    tasks: Annotated[Mapping[str, TaskRecipe], Field(min_length=1)]  # tasks by name
    regions: Annotated[Mapping[Name, Region], Field(min_length=1)]  # regions by name
    budgets_mb: Budgets  # uplink budgets
    replan: Replanning = (
        "stages"  # after stages I and II the rest is planned again, from the scores reached and the megabytes sent
    )
    uploads: Literal["drawn", "planned"] = (
        "drawn"  # samples of stage I: drawn from all vehicles' frames; or the plan says how many each vehicle uploads
    )
    headroom: float = Field(default=0.02, ge=0, lt=0.5)  # fraction left unspent: samples differ in size
    limits: PlanLimits = PlanLimits()  # bounds of the plan's quantities
    horizon_s: Positive | None = None  # longest time that a vehicle trains, over all rounds of all tasks [s]
    stragglers: Stragglers | None = None  # vehicles that train slower, in every region that is simulated
    placement: PlacementSettings = PlacementSettings()  # placement of roadside sensors
    federation: Federation = Federation()  # settings of aggregation


class _Drive(Config):
    """Changes of a run to the defaults of vehicles and recordings, and its arms."""

    navigation: PoseSource = (
        NavigationErrors()
    )  # errors of vehicles' poses and clocks, in labels of tracks and road sensors; or "estimated"
    messages: MessageSettings = MessageSettings()  # by which vehicles announce themselves, of labels with messages
    recording: Recording = Recording()  # changes to how all regions are recorded
    arms: Mapping[Name, Arm] = {}  # arms of a comparison, by name


def _refuse_owners(values: Mapping[str, Any], part: str, model: type[Config]) -> None:
    """Raise ValueError where a part of a recipe is given by region or task, whose own part is below them."""
    given = values.get(part)
    unknown = [name for name in given if name not in model.model_fields] if isinstance(given, Mapping) else []
    for owner, has in (("regions", Region), ("tasks", TaskRecipe)):
        named = values.get(owner)
        odd = next((name for name in unknown if isinstance(named, Mapping) and name in named), None)
        if odd is not None and part in has.model_fields:
            raise ValueError(f"{part}.{odd}: '{odd}' is one of the {owner}; write {owner}.{odd}.{part}")


class RunRecipe(Displayed, RecipeFields, _Drive, LabelFields, _Scene):
    """The recipe of a run: pretraining, edge FL and cloud FL (Wang et al., IEEE Network 37(3), 2023).

    The seed determines traffic, sensor noise and initial weights. docs/runs.md describes every field. Raises pydantic's
    `ValidationError` for a recipe that cannot be run; `load_run_recipe` raises `InputError` with one sentence instead.

    >>> from flcav import RunRecipe
    >>> recipe = RunRecipe.model_validate({
    ...     "tasks": {"objects": {"history": "objects"}},
    ...     "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 3}},
    ...     "budgets_mb": {"wireless": 100, "wireline": 80},
    ... })
    >>> recipe.with_role("federate"), recipe.vehicles("grid"), recipe.placement.rule
    (('grid',), 3, 'vrcsp')
    """

    document: ClassVar = "a run recipe"

    primary_claims: tuple[str, ...] = Field(
        default=(), max_length=3
    )  # what the run is made to decide: edge, cloud, elsewhere, or arms by name; they are corrected apart from others

    @model_validator(mode="before")
    @classmethod
    def _filled(cls, values: Any) -> Any:
        """Fill in defaults: of tasks without fields, and of the tasks whose errors decide the placement."""
        if not isinstance(values, dict) or not isinstance(values.get("tasks"), dict):
            return values
        for part, model in (("recording", Recording), ("training", Training)):
            _refuse_owners(values, part, model)
        tasks = {name: {} if task is None else task for name, task in values["tasks"].items()}
        preset = SIZES.get(str(values.get("size")), SIZES["demo"])[1].local_steps
        values = {**fit_local_steps({**values, "tasks": tasks}, preset)}
        tasks = values["tasks"]
        placement = values.get("placement", {})
        if isinstance(placement, dict) and "tasks" not in placement:
            placement = placement | {"tasks": ["objects"] if "objects" in tasks else []}
        return values | {"tasks": tasks, "placement": placement}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for role in ("pretrain", "federate"):
            if not self.with_role(role):
                raise ValueError(f"regions: one with the role {role} is wanted")
        for name, task in self.tasks.items():
            if (task.history is None) == (task.plan is None):
                raise ValueError(
                    f"tasks: '{name}' needs 'history', learning curves to plan by, or 'plan', a fixed one"
                    + ("; it has both" if task.plan else "")
                )
        for name in self.with_role("federate"):
            known = [f"cav{number}" for number in range(self.vehicles(name))]
            if odd := [each for each in self.regions[name].speed if each not in known]:
                raise ValueError(f"regions.{name}.speed: '{odd[0]}' is none of its vehicles: {', '.join(known)}")
        timed = [
            self.horizon_s,
            self.federation.network,
            *(arm.federation.get("network") for arm in self.arms.values()),
        ]
        if self.stragglers is not None and not any(timed):
            raise ValueError("stragglers: time counts with 'horizon_s' or 'federation.network' alone; give one of them")
        hows = (self.federation.model_dump(), *(arm.federation for arm in self.arms.values()))
        for field in ("replay", "cloud_distillation"):
            trains = any(how.get(field) not in (None, 0) for how in hows)
            if trains and not all(task.pretrains for task in self.tasks.values()):
                raise ValueError(f"federation.{field}: the cloud trains on samples of stage I, and a plan has none")
        for check in load_all(RECIPE_CHECKS):
            check(self)
        if MAIN in self.arms:
            raise ValueError(f"arms: '{MAIN}' is the run itself; choose another name")
        for name, arm in self.arms.items():
            self._check_arm(name, arm)
        claims = (EDGE, CLOUD, ELSEWHERE, *self.arms)
        if unknown := set(self.primary_claims) - set(claims):
            raise ValueError(f"primary_claims: '{sorted(unknown)[0]}' is none of {', '.join(claims)}")
        if unknown := set(self.placement.tasks) - set(self.tasks):
            raise ValueError(
                f"placement.tasks: '{sorted(unknown)[0]}' is none of the run's tasks: {', '.join(self.tasks)}"
            )
        return self

    def _check_arm(self, name: str, arm: Arm) -> None:
        if arm.central in (PRETRAIN, ALL) and not all(task.pretrains for task in self.tasks.values()):
            what = "more pretraining" if arm.central == PRETRAIN else "training on all regions"
            raise ValueError(f"arms.{name}.central: {what} goes with samples of stage I, and a plan has none")
        federating = self.with_role("federate")
        for field, known in (("regions", federating), ("labels", tuple(self.tasks))):
            for each in getattr(arm, field) or ():
                if each not in known:
                    raise ValueError(f"arms.{name}.{field}: '{each}' is none of {', '.join(known)}")
        parts: list[tuple[type[Config], Config, str]] = [
            (PlacementSettings, self.placement, "placement"),
            (Federation, self.federation, "federation"),
            (MessageSettings, self.messages, "messages"),
            *((Training, self.training_of(task), "training") for task in self.tasks),
        ]
        for model, given, part in parts:
            try:
                parse_config(model, given.model_dump() | dict(getattr(arm, part)), f"arms.{name}.{part}")
            except InputError as error:
                raise ValueError(str(error)) from None

    def with_role(self, role: Role) -> tuple[str, ...]:
        """Return the names of the regions of a role, in the recipe's order."""
        return tuple(name for name, region in self.regions.items() if region.role == role)

    @property
    def sized_splits(self) -> Splits:
        """The sizes of the splits: those given, or those of the preset `size`."""
        return self.splits or SIZES[self.size][0]

    def training_of(self, task: str) -> Training:
        """Return a task's training schedule: that of the task, else of the run, else of the preset `size`."""
        return self.tasks[task].training or self.training or SIZES[self.size][1]

    def speeds(self, region: str) -> Mapping[str, float]:
        """Return the relative speeds of a region's vehicles: given ones, and those of stragglers; others have 1."""
        place = self.regions[region]
        drawn = dict[str, float]()
        if self.stragglers is not None and place.role == "federate" and place.data is None:
            names = [f"cav{number}" for number in range(self.vehicles(region))]
            drawn = draw_stragglers(self.stragglers, names, self.seed, region)
        return {**drawn, **place.speed}

    def vehicles(self, region: str) -> int:
        """Return the number of vehicles of a federating region's edge server."""
        return self.regions[region].vehicles or self.sized_splits.edge.cavs


def load_run_recipe(path: Path | str) -> RunRecipe:
    """Load the run recipe (YAML) at `path`; raises `InputError` naming the field, the value and what is allowed.

    Towns, datasets and histories named by a relative path are looked for in the folder `beside` of `run`.

    >>> import flcav
    >>> demo = flcav.load_run_recipe("recipes/runs/demo.yaml")
    >>> demo.budgets_mb.wireless, list(demo.arms)
    (60.0, ['more', 'sweeps'])
    """
    return parse_config(RunRecipe, read_yaml(Path(path)), str(path))


def find_path(name: str, beside: Path) -> Path | None:
    """Return the file or folder `name` in the folder `beside`, or else in the working directory; None for neither."""
    sought = (beside / name, Path.cwd() / name)
    return next((path for path in sought if os.path.exists(path)), None)  # noqa: PTH110 - which takes any name
