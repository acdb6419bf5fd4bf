"""Settings of steps: those that the steps of training have in common."""

from collections.abc import Callable, Mapping

from flcav.config import Config
from flcav.fusion.distillation import Distillation
from flcav.fusion.navigation import NavigationErrors
from flcav.perception.tasks import task_named
from flcav.pipeline.engine import Step
from flcav.pipeline.learning import Learning
from flcav.pipeline.recipe import Budgets, Federation
from flcav.pipeline.sizes import Training


class StepSettings(Config):
    """Settings of a step: all that its result depends on, besides code and the results of the steps it needs."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes, some more than once."""
        return ()


class LearningSettings(Config):
    """Settings of a task's training, from which `flcav.pipeline.learning.Learning` is made."""

    task: str
    network: str | None  # name of the configuration; None: the task's first
    training: Training
    seed: int  # a retraining has one of its own

    def resolve(self) -> Learning:
        """Return the settings with the task itself."""
        return Learning(task_named(self.task), self.network, self.training, self.seed)


class RegionInputs(StepSettings):
    """The steps that a stage of a task in a region rests on, and what chooses its vehicles' frames."""

    region: str
    plan: str  # that the stage is carried out by
    pretrain: str
    frames: str  # recording of the vehicles' training data
    place: str  # placement of the arm's own sensors
    errors: str | None = None  # registration of the task's errors, whose messages come before the rounds
    edge: str | None = None  # stage II that the stage goes on from
    sites: tuple[str, ...] = ()  # placements of all arms: vehicles train on frames near one of their sensors
    group_range_m: float  # as near as that [m]
    recorded: bool  # whether the region is a recorded dataset, whose poles are those that it was recorded from
    pools: Mapping[str, str] = {}  # recordings of the candidates for upload, by region, where vehicles share frames

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of all these steps."""
        named = (self.plan, self.pretrain, self.errors, self.frames, self.place, self.edge)
        return (*(name for name in named if name is not None), *self.sites, *self.pools.values())


class FederationSettings(StepSettings):
    """Settings that the federations of stages II and III have in common."""

    learning: LearningSettings
    federation: Federation
    budgets_mb: Budgets  # of the run
    vehicles: Mapping[str, int]  # of each federating region
    labels: str  # kind of labels, see `LABEL_SOURCES`
    distillation: Distillation | None = None  # of the labels "road-average"
    navigation: NavigationErrors = NavigationErrors()  # of the vehicles
    train_s: float = 0.0  # time that a vehicle of speed 1 trains in a round [s], on a network
    speeds: Mapping[str, float] = {}  # by "region/vehicle"; others have 1


def make_step(name: str, run: Callable[..., None], settings: StepSettings, workers: int = 1) -> Step:
    """Return the step that calls `run` with its settings, after those that they name, on so many workers at most."""
    return Step(name, run, {"settings": settings}, tuple(dict.fromkeys(settings.needs)), workers=workers)
