"""The data of a run: regions, recordings, data splits, and presets of their sizes and of training."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from flcav.config import Config
from flcav.federation.local_steps import MEASURED
from flcav.sensors.rig import CalibrationError
from flcav.sources.recipe import Duration, NamedRig, Warmup
from flcav.storage.records import LEFT_OUT
from flcav.world.map.parameters import RareKinds
from flcav.world.scenarios.scenario import Scenario
from flcav.world.weather import WeatherSchedule

Role = Literal["pretrain", "federate", "unseen"]
SplitName = Literal["pool", "validation", "registry", "edge", "test"]
Count = Annotated[int, Field(ge=0, le=10**6)]
Positive = Annotated[float, Field(gt=0)]

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
    local_steps: int = Field(
        default=MEASURED, ge=1, le=10**6
    )  # optimiser steps of one vehicle in one round; fit: as many as `horizon_s` holds
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


class Recording(Config):
    """Changes to a task's recording settings, by the fields of `flcav.sources.recipe.Recipe`; None: no change."""

    vehicle_rig: NamedRig | None = None
    rigs: Annotated[Mapping[str, NamedRig] | None, LEFT_OUT] = None
    pole_rig: NamedRig | None = None
    weather: WeatherSchedule | None = None
    warmup_s: Warmup | None = None
    every_s: Duration | None = None
    calibration_error: CalibrationError | None = None
    scenarios: tuple[Scenario, ...] | None = None
    rare: RareKinds | None = None
    rare_splits: tuple[SplitName, ...] | None = None  # that `rare` is for; None: all
    worn_paint: float | None = Field(default=None, ge=0, le=1)
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
