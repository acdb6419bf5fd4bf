"""What a user asks to have recorded."""

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from flcav.config import Config
from flcav.sensors.calibration import CalibrationError
from flcav.sensors.rig import RIGS, Rig
from flcav.world.scenarios.scenario import Scenario
from flcav.world.weather import WEATHERS, WeatherSchedule

STEP_S = 0.1  # of the traffic


def _multiple_of_step(value: float) -> float:
    if not np.isclose(value / STEP_S, round(value / STEP_S), atol=1e-6):
        raise ValueError(f"must be a multiple of {STEP_S} s")
    return value


def _poles(value: Any) -> Any:
    numbers = isinstance(value, list | tuple) and all(type(number) is int for number in value)
    if value != "all" and not (numbers and len(set(value)) == len(value)):
        raise ValueError("must be a list of different pole numbers, or 'all'")
    return value


def _rig(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    if value not in RIGS:
        raise ValueError(f"unknown rig; known rigs: {', '.join(RIGS)}")
    return RIGS[value]


Duration = Annotated[float, Field(gt=0, le=36_000), AfterValidator(_multiple_of_step)]
NamedRig = Annotated[Rig, BeforeValidator(_rig)]


class Recipe(Config):
    """Traffic runs in a town, and the vehicles and poles that look at them.

    A scene is one run with its own traffic and its own parked cars; in it, every agent observes
    `spins_per_scene` spins, `every_s` apart, after `warmup_s` in which the town fills.
    """

    town: str  # one of TOWNS, or the folder of a town
    seed: int = Field(default=0, ge=0, lt=2**63)
    split: str = Field(default="train", pattern=r"^[A-Za-z0-9_-]+$")
    scenes: int = Field(default=1, ge=1)
    frames: int | None = Field(default=None, ge=1)  # exactly the first so many, by as many scenes as they take
    warmup_s: Duration = 60.0
    spins_per_scene: int = Field(default=10, ge=1)
    every_s: Duration = 1.0
    cavs: int = Field(default=1, ge=0)
    poles: Annotated[tuple[int, ...] | Literal["all"], BeforeValidator(_poles)] = ()
    vehicle_rig: NamedRig = RIGS["lidar32"]
    pole_rig: NamedRig = RIGS["lidar_pole"]
    weather: WeatherSchedule = WeatherSchedule.model_validate(WEATHERS["clear"])
    calibration_error: CalibrationError = CalibrationError()
    scenarios: tuple[Scenario, ...] = ()  # corner cases that happen in every scene

    @model_validator(mode="after")
    def _scenarios_can_happen(self) -> "Recipe":
        for scenario in self.scenarios:
            if scenario.near and int(scenario.near.removeprefix("cav")) >= self.cavs:
                raise ValueError(f"scenarios: '{scenario.kind}' is near {scenario.near}, but cavs = {self.cavs}")
            if scenario.at_s >= self.times_s()[-1]:
                raise ValueError(f"scenarios: '{scenario.kind}' is at {scenario.at_s:g} s, after the last spin")
        return self

    def times_s(self) -> NDArray[np.float64]:
        """Return the (spins_per_scene,) times of the spins in each run [s]."""
        steps = round(self.warmup_s / STEP_S) + np.arange(self.spins_per_scene) * round(self.every_s / STEP_S)
        return np.round(steps * np.float64(STEP_S), 1)
