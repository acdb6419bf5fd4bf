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
from flcav.federation.rules import Rules
from flcav.fusion.average import NavigationErrors, PoseSource
from flcav.interface.notebook import Displayed
from flcav.network.awareness import MessageSettings
from flcav.network.clock.rounds import NetworkSettings
from flcav.optimization.problem import Budgets
from flcav.runs.registry import RECIPE_CHECKS, ArmFields, FederationFields, LabelFields, RecipeFields, load_all
from flcav.sensors.rig import CalibrationError
from flcav.sources.recipe import Duration, NamedRig, Warmup
from flcav.statistics.streams import stream
from flcav.world.map.parameters import RareKinds
from flcav.world.scenarios.scenario import Scenario
from flcav.world.weather import WeatherSchedule

MAIN = "main"  # the arm that the recipe itself describes
PRETRAIN, EDGE, CLOUD, CENTRAL = "pretrain", "edge", "cloud", "central"
ALL = "all"  # regions that centralised training is on
TRACKING = "tracking"  # of the objects around training frames, for labels of stages II and III
ELSEWHERE = "elsewhere"  # the claim that federated learning helps in regions that do not federate
MORE_EDGE = "more_edge"  # after stage II: as many further edge rounds as stage III has, without the cloud

Role = Literal["pretrain", "federate", "unseen"]
SplitName = Literal["pool", "validation", "registry", "edge", "test"]
Fault = Literal[  # see `flcav.runs.labels.faults`
    "missed", "unsure", "range", "occlusion", "false", "boxes", "presence"
]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_]*$")]
Count = Annotated[int, Field(ge=0, le=10**6)]
Positive = Annotated[float, Field(gt=0)]
RosNamespace = Annotated[str, Field(pattern=ROS_NAMESPACE)]

SPLITS_OF: Mapping[Role, tuple[SplitName, ...]] = {  # splits of a region, by its role
    "pretrain": ("pool", "validation", "test"),
    "federate": ("validation", "registry", "edge", "test"),
    "unseen": ("validation", "test"),
}


class Split(Config):
    """Size of a data split in one region: `scenes` x `spins` x `cavs` frames."""

    scenes: int = Field(ge=1, le=10**6)  # traffic runs
    spins: int = Field(ge=1, le=10**6)  # frames of each vehicle in a scene
    cavs: int = Field(ge=1, le=8)  # vehicles that record; of the split `edge` also the default of a region's `vehicles`
    every_s: float = Field(default=4.0, ge=2.0)  # time between two frames [s]; nearer ones would be alike


class Splits(Config):
    """Sizes of all data splits. Each split has traffic of its own, so that no scene is in two of them."""

    pool: Split  # pretraining regions: candidates for the upload of stage I
    validation: Split  # every region: scored during training
    registry: Split  # federating regions: errors are registered here
    edge: Split  # federating regions: the vehicles' training data
    test: Split  # every region: scored once, at the end

    @field_validator("test")
    @classmethod
    def _several_scenes(cls, test: Split) -> Split:
        if test.scenes < 2:
            raise ValueError("test frames of two scenes or more are wanted: intervals are over scenes")
        return test


class Training(Config):
    """Training of a task's networks. Rates are fractions of the task's own learning rate."""

    batch: int | None = Field(default=None, ge=1, le=4096)  # samples per optimiser step; default: the task's
    steps: int = Field(default=1400, ge=1, le=10**6)  # optimiser steps of pretraining, with the task's own schedule
    local_steps: int = Field(default=16, ge=1, le=10**6)  # optimiser steps of one vehicle in one round
    local_rate: float = Field(default=0.5, gt=0)  # learning rate of the first round after pretraining
    final_rate: float = Field(default=0.1, gt=0)  # learning rate of their last, and of further rounds after them
    average_rounds: int = Field(default=3, ge=1)  # last rounds of a federation whose models its result averages
    start_share: float = Field(default=0.3, ge=0, lt=1)  # of the pretrained weights in the result of stage II
    imitation: float = Field(
        default=0.0, ge=0
    )  # weight of the loss by which detectors keep the boxes of the pretrained network in stages II and III


SIZES: Mapping[str, tuple[Splits, Training]] = {
    "toy": (  # seconds: a smoke test, its scores mean nothing
        Splits(
            pool=Split(scenes=2, spins=3, cavs=4),
            validation=Split(scenes=1, spins=2, cavs=3),
            registry=Split(scenes=1, spins=2, cavs=2),
            edge=Split(scenes=1, spins=2, cavs=2),
            test=Split(scenes=3, spins=1, cavs=2),
        ),
        Training(steps=12, local_steps=1),
    ),
    "demo": (  # under ten minutes on two cores
        Splits(
            pool=Split(scenes=16, spins=5, cavs=4),
            validation=Split(scenes=8, spins=2, cavs=3),
            registry=Split(scenes=8, spins=3, cavs=4),
            edge=Split(scenes=16, spins=5, cavs=4),
            test=Split(scenes=30, spins=1, cavs=4),
        ),
        Training(steps=1000),
    ),
    "full": (
        Splits(
            pool=Split(scenes=20, spins=5, cavs=4),
            validation=Split(scenes=10, spins=2, cavs=3),
            registry=Split(scenes=10, spins=3, cavs=4),
            edge=Split(scenes=24, spins=5, cavs=4),
            test=Split(scenes=40, spins=2, cavs=4),
        ),
        Training(),
    ),
}


class Stragglers(Config):
    """Share of each federating region's vehicles that train slower, and by what factor."""

    share: float = Field(gt=0, le=1)  # of the vehicles, rounded to whole ones
    slower: float = Field(gt=1, le=1000)  # times as long as a vehicle of speed 1


def draw_stragglers(how: Stragglers, vehicles: Sequence[str], seed: int, region: str) -> dict[str, float]:
    """Return the speed of each straggler among a region's vehicles; others have 1."""
    drawn: list[int] = stream(seed, "stragglers", region).permutation(len(vehicles)).tolist()
    return {vehicles[number]: 1 / how.slower for number in sorted(drawn[: round(how.share * len(vehicles))])}


class FixedPlan(Config):
    """A task's plan, given by hand instead of computed."""

    samples: Count  # samples uploaded for pretraining; 0: none, and the network stays that of `weights`
    edge_rounds: Count  # rounds of edge FL
    cloud_rounds: Count  # rounds of cloud FL


class Recording(Config):
    """Changes to a task's recording settings, by the fields of `flcav.sources.recipe.Recipe`; None: no change."""

    vehicle_rig: NamedRig | None = None
    pole_rig: NamedRig | None = None
    weather: WeatherSchedule | None = None
    warmup_s: Warmup | None = None
    every_s: Duration | None = None
    calibration_error: CalibrationError | None = None
    scenarios: tuple[Scenario, ...] | None = None
    rare: RareKinds | None = None
    rare_splits: tuple[SplitName, ...] | None = None  # that `rare` is for; None: all
    source: Literal["carla"] | None = None  # from CARLA, with the fields of `CarlaRecipe` below
    host: str | None = None
    port: int | None = None
    traffic_port: int | None = None
    timeout_s: float | None = None
    map: str | None = None
    vehicles: int | None = None
    pedestrians: int | None = None

    def fields(self, split: SplitName) -> dict[str, Any]:
        """Return the fields of a split that are not None, as JSON values."""
        others = {"rare_splits"} if split in (self.rare_splits or (split,)) else {"rare", "rare_splits"}
        return self.model_dump(mode="json", exclude=others, exclude_none=True)


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


class Region(Config):
    """A region with its vehicles and edge server: a town to simulate, or datasets already recorded."""

    role: Role  # pretrain, federate or unseen
    town: str | None = None  # name or folder of a town; default: the region's name
    data: str | Mapping[SplitName, str] | None = (
        None  # recorded dataset whose scenes are divided over the splits, or one dataset per split
    )
    vehicles: int | None = Field(default=None, ge=1, le=8)  # clients of the edge server
    speed: Mapping[str, Positive] = {}  # by vehicle (cav0, cav1, …): rounds it trains in the time of one; default: 1
    recording: Recording = Recording()  # changes to how the region is recorded

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.town is not None and self.data is not None:
            raise ValueError("give either 'town' or 'data'")
        if isinstance(self.data, Mapping) and (missing := set(SPLITS_OF[self.role]) - set(self.data)):
            raise ValueError(f"'data' lacks {', '.join(sorted(missing))}, which a region to {self.role} needs")
        if self.vehicles is not None and (self.role != "federate" or self.data is not None):
            raise ValueError("'vehicles' belong to a town with the role federate")
        if self.speed and (self.role != "federate" or self.data is not None):
            raise ValueError("'speed' belongs to a town with the role federate")
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
    score_statistics: bool = False  # validate stage III also with each region's own statistics of batch normalisation
    network: NetworkSettings | None = None  # radio, wireline and rules of rounds; default: every message arrives


class Federation(FederationFields, _Strategies):
    """Settings of federated learning: strategies, the rules of the vehicles' rounds, and those of extras."""

    cloud_topics: RosNamespace | None = None  # edge servers and cloud exchange parameters by ROS 2 topics below it


def _name_replanning(value: Any) -> Any:
    if value == "rounds":
        raise ValueError("plans are updated between stages, not between rounds: write 'stages'")
    return ("stages" if value else "none") if isinstance(value, bool) else value


Replanning = Annotated[Literal["none", "stages"], BeforeValidator(_name_replanning)]


class _PlannedArm(Config):
    """How an arm differs from the run in plan, placement, federation and labels."""

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
    stages: tuple[Literal["edge", "cloud", "more_edge"], ...] = (
        "edge",
        "cloud",
    )  # stages of federated learning to run; more_edge: further edge rounds instead of the cloud rounds
    regions: tuple[str, ...] | None = None  # federating regions that take part; default: all

    @model_validator(mode="after")
    def _uploads_are_learned_from(self) -> "Arm":
        if self.uploads is not None and self.central != "federate":
            raise ValueError("uploads: of centralised training alone; it goes with 'central: federate'")
        return self

    @field_validator("stages")
    @classmethod
    def _from_the_first(cls, stages: tuple[str, ...]) -> tuple[str, ...]:
        if stages not in ((EDGE,), (EDGE, CLOUD), (EDGE, MORE_EDGE)):
            raise ValueError("must be [edge], [edge, cloud] or [edge, more_edge]")
        return stages


class _Scene(Config):
    """What is run: tasks, regions, budgets, rules."""

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
    """How vehicles and recordings of a run differ from the defaults, and its arms."""

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
        replays = any(
            how.get("replay") for how in (self.federation.model_dump(), *(arm.federation for arm in self.arms.values()))
        )
        if replays and not all(task.pretrains for task in self.tasks.values()):
            raise ValueError("federation.replay: the cloud trains on samples of stage I, and a plan has none")
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
        for model, own, part in parts:
            try:
                parse_config(model, own.model_dump() | dict(getattr(arm, part)), f"arms.{name}.{part}")
            except InputError as error:
                raise ValueError(str(error)) from None

    def with_role(self, role: Role) -> tuple[str, ...]:
        """Return the names of the regions of a role, in the recipe's order."""
        return tuple(name for name, region in self.regions.items() if region.role == role)

    @property
    def sized_splits(self) -> Splits:
        """Return the sizes of the splits: the recipe's own, or those of the preset `size`."""
        return self.splits or SIZES[self.size][0]

    def training_of(self, task: str) -> Training:
        """Return a task's training schedule: its own, else the run's, else that of the preset `size`."""
        return self.tasks[task].training or self.training or SIZES[self.size][1]

    def speeds(self, region: str) -> Mapping[str, float]:
        """Return the speeds of a region's vehicles, its own and those of stragglers; others have 1."""
        own, drawn = self.regions[region], dict[str, float]()
        if self.stragglers is not None and own.role == "federate" and own.data is None:
            names = [f"cav{number}" for number in range(self.vehicles(region))]
            drawn = draw_stragglers(self.stragglers, names, self.seed, region)
        return {**drawn, **own.speed}

    def vehicles(self, region: str) -> int:
        """Return the number of vehicles of a federating region's edge server."""
        return self.regions[region].vehicles or self.sized_splits.edge.cavs


def load_run_recipe(path: Path | str) -> RunRecipe:
    """Return the run recipe (YAML) at `path`; raises `InputError` naming the field, the value and what is allowed.

    Towns, datasets and histories named by a relative path are looked for in the folder `beside` of `run`.

    >>> import flcav
    >>> demo = flcav.load_run_recipe("recipes/runs/demo.yaml")
    >>> demo.budgets_mb.wireless, list(demo.arms)
    (80.0, ['more'])
    """
    return parse_config(RunRecipe, read_yaml(Path(path)), str(path))


def find_path(name: str, beside: Path) -> Path | None:
    """Return the file or folder `name` in the folder `beside`, or else in the working directory; None for neither."""
    sought = (beside / name, Path.cwd() / name)
    return next((path for path in sought if os.path.exists(path)), None)  # noqa: PTH110 - which takes any name
