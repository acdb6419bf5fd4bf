"""What a run is asked to do: tasks, regions, budgets, placement, federation, and the arms that it compares."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from flcav.config import Config, InputError, parse_config, read_yaml
from flcav.sensors.calibration import CalibrationError
from flcav.sources.recipe import Duration, NamedRig, Warmup
from flcav.world.scenarios.scenario import Scenario
from flcav.world.weather import WeatherSchedule

MAIN = "main"  # the arm that the recipe itself describes
PRETRAIN, EDGE, CLOUD, CENTRAL = "pretrain", "edge", "cloud", "central"

Role = Literal["pretrain", "federate", "unseen"]
SplitName = Literal["pool", "validation", "registry", "edge", "test"]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_]*$")]
Count = Annotated[int, Field(ge=0, le=10**6)]
Positive = Annotated[float, Field(gt=0)]

SPLITS_OF: Mapping[Role, tuple[SplitName, ...]] = {  # what is recorded of a region
    "pretrain": ("pool", "validation", "test"),
    "federate": ("validation", "registry", "edge", "test"),
    "unseen": ("validation", "test"),
}


class Split(Config):
    """Frames of one purpose in one region: `scenes` x `spins` x `cavs` of them."""

    scenes: int = Field(ge=1, le=10**6)
    spins: int = Field(ge=1, le=10**6)  # of each vehicle in a scene
    cavs: int = Field(ge=1, le=8)  # vehicles; of `edge`, where the region does not say
    every_s: float = Field(default=4.0, ge=2.0)  # so that a network does not see the same second twice


class Splits(Config):
    """Frames of every purpose; each has traffic of its own, so that no scene is in two of them."""

    pool: Split  # pretraining regions: what stage I may choose from
    validation: Split  # every region: what training is watched on
    registry: Split  # federating regions: where errors are registered
    edge: Split  # federating regions: what their vehicles learn from
    test: Split  # every region: looked at once, at the end

    @field_validator("test")
    @classmethod
    def _several_scenes(cls, test: Split) -> Split:
        if test.scenes < 2:
            raise ValueError("test frames of two scenes or more are wanted: intervals are over scenes")
        return test


class Training(Config):
    """How long and how fast networks train; rates are shares of the task's own learning rate."""

    batch: int | None = Field(default=None, ge=1, le=4096)  # samples of a step; None: the task's
    block_steps: int = Field(default=100, ge=1, le=10**6)  # pretraining goes in blocks, validated after each
    max_blocks: int = Field(default=12, ge=1, le=10**4)
    patience: int = Field(default=3, ge=1)  # blocks without `min_gain` after which validation has levelled off
    min_gain: float = Field(default=0.01, ge=0)
    cooldown: tuple[float, ...] = (0.3, 0.05)  # rates of the blocks after that
    local_steps: int = Field(default=16, ge=1, le=10**6)  # of a vehicle in a round
    local_rate: float = Field(default=0.5, gt=0)  # in the first round
    final_rate: float = Field(default=0.1, gt=0)  # in the last


class FixedPlan(Config):
    """A task's plan that was chosen by hand."""

    samples: int = Field(ge=1, le=10**6)
    edge_rounds: Count
    cloud_rounds: Count


class Recording(Config):
    """How frames are recorded where it is not as the task has it: fields of a recording's recipe."""

    vehicle_rig: NamedRig | None = None
    pole_rig: NamedRig | None = None
    weather: WeatherSchedule | None = None
    warmup_s: Warmup | None = None
    every_s: Duration | None = None
    calibration_error: CalibrationError | None = None
    scenarios: tuple[Scenario, ...] | None = None

    def fields(self) -> dict[str, Any]:
        """Return the fields that are given."""
        return {name: value for name, value in self.model_dump(mode="json").items() if value is not None}


class TaskRecipe(Config):
    """What is learned of one task."""

    network: str | None = None  # name of the configuration; None: the task's first
    weight: Positive = 1.0  # in the plan
    labels: str | None = None  # of stages II and III; None: the task's first kind
    history: str | None = None  # learning curves: a history of the package, or a table beside the recipe
    plan: FixedPlan | None = None  # instead of a history
    recording: Recording = Recording()
    training: Training | None = None  # None: the run's


class Region(Config):
    """A town with vehicles and an edge server, or datasets that were recorded already."""

    role: Role
    town: str | None = None  # a town's name or folder; None: the region's name
    data: str | Mapping[SplitName, str] | None = None  # a dataset's folder, whose scenes are dealt; or one per split
    vehicles: int | None = Field(default=None, ge=1, le=8)  # of a federating town
    recording: Recording = Recording()

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.town is not None and self.data is not None:
            raise ValueError("give either 'town' or 'data'")
        if isinstance(self.data, Mapping) and (missing := set(SPLITS_OF[self.role]) - set(self.data)):
            raise ValueError(f"'data' lacks {', '.join(sorted(missing))}, which a region to {self.role} needs")
        if self.vehicles is not None and (self.role != "federate" or self.data is not None):
            raise ValueError("'vehicles' belong to a town with the role federate")
        return self


class Budgets(Config):
    """Uplink budgets [MB; 1 MB = 10^6 bytes]."""

    wireless: Positive
    wireline: Positive


class Limits(Config):
    """Least and most of what a plan may take of each stage."""

    samples: tuple[Count, Count | None] = (40, None)  # None: all that the pools hold
    edge_rounds: tuple[Count, Count] = (1, 6)
    cloud_rounds: tuple[Count, Count] = (1, 3)


class Placement(Config):
    """Where roadside sensors stand."""

    rule: Literal["vrcsp", "densest", "none"] = "vrcsp"  # most errors covered; most traffic around; no sensor
    count: int = Field(default=1, ge=1, le=100)  # per region
    range_m: float = Field(default=40.0, gt=0, le=1000)
    group_range_m: float = Field(default=60.0, gt=0, le=10_000)  # a group: vehicles this near to a sensor of any arm
    tasks: tuple[str, ...] = ()  # whose errors count; if not given, objects where they are learned


class Federation(Config):
    """How models are averaged."""

    strategy: str = "fedavg"  # a name, or module:NAME of one's own
    edge_rounds_per_cloud_round: int = Field(default=1, ge=1, le=100)


class Arm(Config):
    """A comparison: what is different from the run itself, and how much of it is run."""

    plan: Literal["joint", "equal-stages", "equal-tasks", "max-throughput"] = "joint"
    placement: Mapping[str, Any] = {}  # fields of `Placement` that differ
    federation: Mapping[str, Any] = {}  # of `Federation`
    labels: Mapping[str, str] = {}  # by task
    central: Literal["pretrain", "federate"] | None = None  # train on, centrally, on ground truth of these regions
    stages: tuple[Literal["edge", "cloud"], ...] = ("edge", "cloud")
    regions: tuple[str, ...] | None = None  # that federate; None: all

    @field_validator("stages")
    @classmethod
    def _from_the_first(cls, stages: tuple[str, ...]) -> tuple[str, ...]:
        if stages not in ((EDGE,), (EDGE, CLOUD)):
            raise ValueError("must be [edge] or [edge, cloud]")
        return stages


class RunRecipe(Config):
    """One run of the three stages: pretraining, edge FL, cloud FL (Wang et al., IEEE Network 37(3), 2023).

    A seed names its traffic, its sensors' noise and its networks' weights. docs/runs.md has every field. Raises
    pydantic's `ValidationError` for what cannot be run; `load_run_recipe` makes one sentence of it.

    >>> from flcav import RunRecipe
    >>> recipe = RunRecipe.model_validate({
    ...     "tasks": {"objects": {"history": "objects"}},
    ...     "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 3}},
    ...     "budgets_mb": {"wireless": 100, "wireline": 80},
    ... })
    >>> recipe.with_role("federate"), recipe.vehicles("grid"), recipe.placement.rule
    (('grid',), 3, 'vrcsp')
    """

    seed: int = Field(default=1, ge=0, lt=2**31)
    size: Literal["toy", "demo", "full"] = "demo"  # of what `splits` and `training` do not say
    splits: Splits | None = None
    training: Training | None = None
    tasks: Annotated[Mapping[str, TaskRecipe], Field(min_length=1)]
    regions: Annotated[Mapping[Name, Region], Field(min_length=1)]
    budgets_mb: Budgets
    headroom: float = Field(default=0.02, ge=0, lt=0.5)  # share that the plan leaves unspent: samples differ in size
    limits: Limits = Limits()
    placement: Placement = Placement()
    federation: Federation = Federation()
    recording: Recording = Recording()
    arms: Mapping[Name, Arm] = {}

    @model_validator(mode="before")
    @classmethod
    def _filled(cls, values: Any) -> Any:
        """Take a task without fields for one of defaults, and place by the errors of objects where they are learned."""
        if not isinstance(values, dict) or not isinstance(values.get("tasks"), dict):
            return values
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
        if MAIN in self.arms:
            raise ValueError(f"arms: '{MAIN}' is the run itself; choose another name")
        for name, arm in self.arms.items():
            self._check_arm(name, arm)
        if unknown := set(self.placement.tasks) - set(self.tasks):
            raise ValueError(
                f"placement.tasks: '{sorted(unknown)[0]}' is none of the run's tasks: {', '.join(self.tasks)}"
            )
        return self

    def _check_arm(self, name: str, arm: Arm) -> None:
        federating = self.with_role("federate")
        for field, known in (("regions", federating), ("labels", tuple(self.tasks))):
            for each in getattr(arm, field) or ():
                if each not in known:
                    raise ValueError(f"arms.{name}.{field}: '{each}' is none of {', '.join(known)}")
        for model, part in ((Placement, "placement"), (Federation, "federation")):
            try:
                parse_config(model, getattr(self, part).model_dump() | dict(getattr(arm, part)), f"arms.{name}.{part}")
            except InputError as error:
                raise ValueError(str(error)) from None

    def with_role(self, role: Role) -> tuple[str, ...]:
        """Return the names of the regions of a role, in order."""
        return tuple(name for name, region in self.regions.items() if region.role == role)

    @property
    def sized_splits(self) -> Splits:
        """Return the splits: those written out, or those of the size."""
        return self.splits or SIZES[self.size][0]

    def training_of(self, task: str) -> Training:
        """Return how a task's networks train: its own, the run's, or as the size says."""
        return self.tasks[task].training or self.training or SIZES[self.size][1]

    def vehicles(self, region: str) -> int:
        """Return how many vehicles a federating town's edge server has."""
        return self.regions[region].vehicles or self.sized_splits.edge.cavs


SIZES: Mapping[str, tuple[Splits, Training]] = {
    "toy": (  # seconds: shows that a run works, and nothing else
        Splits(
            pool=Split(scenes=2, spins=3, cavs=4),
            validation=Split(scenes=1, spins=2, cavs=3),
            registry=Split(scenes=1, spins=2, cavs=2),
            edge=Split(scenes=1, spins=2, cavs=2),
            test=Split(scenes=3, spins=1, cavs=2),
        ),
        Training(block_steps=4, max_blocks=2, patience=1, cooldown=(0.2,), local_steps=1),
    ),
    "demo": (  # what two cores do in under ten minutes
        Splits(
            pool=Split(scenes=16, spins=5, cavs=4),
            validation=Split(scenes=8, spins=2, cavs=3),
            registry=Split(scenes=8, spins=3, cavs=4),
            edge=Split(scenes=16, spins=5, cavs=4),
            test=Split(scenes=30, spins=1, cavs=4),
        ),
        Training(max_blocks=9),
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


def load_run_recipe(path: Path | str) -> RunRecipe:
    """Return the run recipe (YAML) at `path`; raises `InputError` naming the field, the value and what is allowed.

    Towns, datasets and histories that it names by a path are looked for in the folder that `run` is told.

    >>> import flcav
    >>> demo = flcav.load_run_recipe("recipes/runs/demo.yaml")
    >>> demo.budgets_mb.wireless, list(demo.arms)
    (180.0, ['densest'])
    """
    return parse_config(RunRecipe, read_yaml(Path(path)), str(path))
