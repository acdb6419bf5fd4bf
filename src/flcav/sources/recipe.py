"""Recording recipes: validated YAML files that define a dataset, and the division of its frames into scenes."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from flcav.config import Config, InputError, Json, parse_config, read_yaml, shorten
from flcav.geometry import Array
from flcav.interface.notebook import Displayed
from flcav.interface.wording import suggest
from flcav.sensors.frame import LONGEST_NAME, format_key
from flcav.sensors.lens import Lens
from flcav.sensors.rig import RIGS, CalibrationError, Mounted, MountedInfrared, MountedRadar, Rig
from flcav.sources.randomisation import Drawing
from flcav.storage.records import WHERE_TRUE
from flcav.world.map.parameters import RareKinds
from flcav.world.map.town import PACKAGED
from flcav.world.scenarios.scenario import LONGEST_S, Scenario
from flcav.world.weather import WEATHERS, WeatherSchedule

STEP_S = 0.1  # step of the traffic simulation
LEAST_IMU_HZ = 20.0  # of navigation logs
MOST = 10**6  # upper limit of scenes, frames and spins


def _multiple_of_step(value: float) -> float:
    if not np.isclose(value / STEP_S, round(value / STEP_S), atol=1e-6):
        raise ValueError(f"must be a multiple of {STEP_S} s")
    return value


def _warmup(value: Any) -> Any:
    ends = value if isinstance(value, list | tuple) else (value, value)
    numbers = len(ends) == 2 and all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends)
    if not numbers or not 0 < ends[0] <= ends[1] <= LONGEST_S:
        raise ValueError(f"must be seconds above 0 and up to {LONGEST_S:g}, or two such numbers, the lower first")
    for end in ends:
        _multiple_of_step(end)
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


Duration = Annotated[float, Field(gt=0, le=LONGEST_S), AfterValidator(_multiple_of_step)]
Warmup = Annotated[float | tuple[float, float], BeforeValidator(_warmup)]
NamedRig = Annotated[Rig, BeforeValidator(_rig)]


class Recipe(Displayed, Config):
    """A recording recipe: a town, its traffic runs, and the agents that observe them.

    A scene is one traffic run with its own parked cars. After a warm-up of `warmup_s`, in which the town fills, every
    agent observes `spins_per_scene` spins, `every_s` apart, and with `window_s` more before and after each of them.
    Raises pydantic's ValidationError, which names the field.

    >>> from flcav import Recipe
    >>> recipe = Recipe(town="grid", seed=1, scenes=6, cavs=4, poles="all")
    >>> recipe.scenes * recipe.spins_per_scene * recipe.cavs  # frames of the vehicles
    240
    """

    document: ClassVar = "a dataset recipe"

    town: str  # name of a town of flcav, or folder of an imported one
    seed: int = Field(
        default=0, ge=0, lt=2**63
    )  # seed of traffic, parked cars and sensor noise; the same seed gives the same bytes
    split: str = Field(default="train", pattern=r"^[A-Za-z0-9_-]+$")  # data split, e.g. train, validation, test
    scenes: int = Field(default=1, ge=1, le=MOST)  # scenes, each a traffic run of its own
    frames: int | None = Field(
        default=None, ge=1, le=MOST
    )  # total number of frames, those of `window_s` included; it overrides `scenes`
    warmup_s: Warmup = 60.0  # traffic before the first spin; two numbers: drawn uniformly between them for each scene
    spins_per_scene: int = Field(
        default=10, ge=1, le=MOST
    )  # LiDAR spins without those of `window_s`; every agent records a frame at each
    every_s: Duration = 1.0  # time between two of these spins, a multiple of 0.1 s
    window_s: Annotated[float, Field(ge=0, le=10), AfterValidator(_multiple_of_step)] = (
        0.0  # above 0: further spins up to so long before and after each of the others, a multiple of 0.1 s
    )
    window_every_s: Annotated[float, Field(ge=0.1), AfterValidator(_multiple_of_step)] | None = (
        None  # time between the spins of a window, a multiple of 0.1 s; None: only those at its ends
    )
    window_range_m: Annotated[float, Field(gt=0)] | None = (
        None  # where poles record, vehicles record windows only of spins within this of one of them, and poles none [m]
    )
    navigation_s: Annotated[float, Field(ge=0, le=LONGEST_S), AfterValidator(_multiple_of_step)] = (
        0.0  # above 0: navigation logs of the vehicles, from up to so long before the first spin to the last
    )
    cavs: int = Field(default=1, ge=0, le=1000)  # connected vehicles that record: cav0, cav1, ...
    poles: Annotated[tuple[int, ...] | Literal["all"], BeforeValidator(_poles)] = ()  # numbers of the poles that record
    vehicle_rig: NamedRig = RIGS["lidar32"]  # every vehicle's sensors: the name of a rig, or a rig
    rigs: Annotated[Mapping[str, NamedRig], WHERE_TRUE] = {}  # of single vehicles, by name (cav0, ...), instead of it
    pole_rig: NamedRig = RIGS["lidar_pole"]  # every pole's sensors: the name of a rig, or a rig
    weather: WeatherSchedule = WeatherSchedule.model_validate(WEATHERS["clear"])  # preset, values, keyframes, classes
    calibration_error: CalibrationError = CalibrationError()  # errors of the calibration that agents assume
    scenarios: tuple[Scenario, ...] = ()  # corner cases, in every scene
    rare: RareKinds = Field(default={})  # shares of rare kinds of objects among the vehicles of their category
    worn_paint: float = Field(default=0.0, ge=0, le=1)  # wear of the road markings; above 0 it replaces the town's
    randomise: Drawing | None = (
        None  # streets, sizes of cars and LiDARs drawn by `seed`; lidars: from 16 beams on; wide: with bays, too
    )

    @model_validator(mode="after")
    def _ends(self) -> "Recipe":
        if round(self.window_s / STEP_S) >= self.warmup_steps[0]:
            raise ValueError(f"window_s = {self.window_s:g} puts the first spin before the traffic: warmup_s is longer")
        last_s = self.warmup_steps[1] * STEP_S + (self.spins_per_scene - 1) * self.every_s + self.window_s
        if last_s > LONGEST_S:
            raise ValueError(
                "warmup_s, spins_per_scene, every_s and window_s put the last spin at "
                f"{last_s:g} s, after {LONGEST_S:g} s"
            )
        return self

    @model_validator(mode="after")
    def _scenarios_can_happen(self) -> "Recipe":
        for scenario in self.scenarios:
            if scenario.near and int(scenario.near.removeprefix("cav")) >= self.cavs:
                raise ValueError(f"scenarios: '{scenario.kind}' is near {scenario.near}, but cavs = {self.cavs}")
            if scenario.at_s >= self.times_s(self.warmup_steps[0])[-1]:
                raise ValueError(f"scenarios: '{scenario.kind}' is at {scenario.at_s:g} s, after the last spin")
        return self

    @model_validator(mode="after")
    def _rigs_of_vehicles(self) -> "Recipe":
        vehicles = [f"cav{number}" for number in range(self.cavs)]
        if strangers := [name for name in self.rigs if name not in vehicles]:
            raise ValueError(
                f"rigs names '{strangers[0]}', which is none of the vehicles {', '.join(vehicles) or '(none)'}"
            )
        if self.navigation_s and not all(rig.gnss and rig.imus for rig in self.rigs.values()):
            raise ValueError(
                "navigation_s: every vehicle needs a GNSS receiver and an IMU; give them to its rig in 'rigs'"
            )
        return self

    @model_validator(mode="after")
    def _whole_windows(self) -> "Recipe":
        if self.window_every_s is not None and self.window_every_s > self.window_s:
            raise ValueError(
                f"window_every_s = {self.window_every_s:g} leaves no spin within window_s = {self.window_s:g}"
            )
        if self.window_range_m is not None and not self.window_s:
            raise ValueError("window_range_m: there are no windows around spins; give 'window_s'")
        return self

    @model_validator(mode="after")
    def _navigates(self) -> "Recipe":
        if self.navigation_s and not (self.vehicle_rig.gnss and self.vehicle_rig.imus):
            raise ValueError("navigation_s: the vehicles need a GNSS receiver and an IMU; give them a 'vehicle_rig'")
        slow = [imu.settings.rate_hz for imu in self.vehicle_rig.imus.values() if imu.settings.rate_hz < LEAST_IMU_HZ]
        if self.navigation_s and slow:
            raise ValueError(f"navigation_s: an IMU of {slow[0]:g} Hz is too slow; {LEAST_IMU_HZ:g} Hz or more are")
        return self

    @property
    def warmup_steps(self) -> tuple[int, int]:
        """Return the shortest and the longest warm-up of a scene, in steps of the traffic."""
        ends = self.warmup_s if isinstance(self.warmup_s, tuple) else (self.warmup_s, self.warmup_s)
        return round(ends[0] / STEP_S), round(ends[1] / STEP_S)

    @property
    def spins(self) -> int:
        """Return the number of spins of a scene, those of the windows included."""
        return len(self._steps())

    @property
    def middle_spins(self) -> tuple[int, ...]:
        """Return the indices, among all spins, of the `spins_per_scene` spins, which are the middles of windows."""
        return tuple(np.flatnonzero(np.isin(self._steps(), self._middle_steps())).tolist())

    def find_middles(self, spin: int) -> NDArray[np.int64]:
        """Return the indices, among all spins, of the `spins_per_scene` spins whose window contains the spin `spin`."""
        middle = np.array(self.middle_spins)
        away = np.abs(self._steps()[middle] - self._steps()[spin])
        return middle[away <= round(self.window_s / STEP_S)]

    def times_s(self, warmup_steps: int) -> Array:
        """Return (spins,) the times of the spins [s] after a warm-up of `warmup_steps` steps of STEP_S."""
        return np.round((warmup_steps + self._steps()) * np.float64(STEP_S), 1)

    def _middle_steps(self) -> NDArray[np.int64]:
        return np.arange(self.spins_per_scene) * round(self.every_s / STEP_S)

    def _steps(self) -> NDArray[np.int64]:
        """Return the steps of all spins since the end of the warm-up, ascending."""
        aside = round(self.window_s / STEP_S)
        every = aside if self.window_every_s is None else round(self.window_every_s / STEP_S)
        offsets = np.arange(every, aside + 1, every) if every else np.zeros(0, dtype=np.int64)
        around = np.concatenate((-offsets, (0,), offsets)).astype(np.int64)
        return np.unique(self._middle_steps()[:, None] + around)


class CarlaRecipe(Recipe):
    """A recording recipe for CARLA: the fields of any other, with a server, its map and its traffic.

    Refused are the fields that CARLA has nothing for. Of rigs they are refused, too: see `refuse_unknown_to_carla`.
    """

    source: Literal["carla"]  # record from CARLA, by its client (extra `carla`)
    host: str = Field(default="127.0.0.1", min_length=1, max_length=255)  # the computer that CARLA's server runs on
    port: int = Field(default=2000, ge=1, le=65_534)  # port of its calls; the next one is that of its streams
    traffic_port: int = Field(default=8000, ge=1, le=65_535)  # port of the Traffic Manager, which runs in this process
    timeout_s: float = Field(default=60.0, ge=1, le=3600)  # longest wait for an answer, and for a sensor's data
    map: str | None = Field(default=None, min_length=1, max_length=100)  # map of the server; None: the town's name
    vehicles: int = Field(default=30, ge=0, le=1000)  # vehicles of the Traffic Manager, beside those that record
    pedestrians: int = Field(default=0, ge=0, le=1000)  # walkers of CARLA's own, where a map has a navigation mesh

    @model_validator(mode="after")
    def _has_what_carla_has(self) -> "CarlaRecipe":
        for name in ("scenarios", "rare", "randomise", "window_range_m", "worn_paint", "rigs"):
            if getattr(self, name):
                raise ValueError(f"'{name}' is of the built-in simulator; source: carla has no such thing")
        for name in ("vehicle_rig", "pole_rig"):
            refuse_unknown_to_carla(name, getattr(self, name))
        return self


def refuse_unknown_to_carla(field: str, rig: Rig) -> None:
    """Raise ValueError where a sensor of `rig`, the recipe's `field`, has a property that CARLA does not simulate."""
    for name, lidar in rig.lidars.items():
        if lidar.settings.elevations_deg is not None or lidar.settings.rolling:
            what = "uneven channels" if lidar.settings.elevations_deg is not None else "a rolling spin"
            raise ValueError(f"{field}: '{name}' has {what}, and CARLA's LiDAR has not")
    for name, camera in rig.cameras.items():
        lens = camera.settings
        centred = Lens(width=lens.width, height=lens.height, fov_deg=lens.fov_deg, fx=lens.fx)
        if not np.allclose(lens.intrinsics(), centred.intrinsics()) or lens.distortion().any():
            raise ValueError(
                f"{field}: '{name}' has distortion, unequal focal lengths or a principal point off the image's centre, "
                "and CARLA's camera has not"
            )
    for name, sensor in rig.sensors().items():
        if isinstance(sensor, MountedInfrared | MountedRadar):
            kind = "thermal camera" if isinstance(sensor, MountedInfrared) else "radar with cross-sections"
            raise ValueError(f"{field}: '{name}' is a {kind}, and CARLA has none")
        if isinstance(sensor, Mounted) and sensor.trigger_ms:
            raise ValueError(f"{field}: '{name}' has a trigger time, and CARLA's sensors measure at its ticks")


def recipe_path(name: str) -> Path:
    """Return the path of the packaged recipe `name`, e.g. "objects" or "allocation/three_tasks".

    Recipes are in the folder `recipes/` of a checkout, and within the package of an installation. Raises `InputError`
    for an unknown name.
    """
    package = Path(__file__).parents[1]
    folder = next(filter(Path.is_dir, (package / "recipes", package.parents[1] / "recipes")))
    known = {file.relative_to(folder).with_suffix("").as_posix(): file for file in sorted(folder.rglob("*.yaml"))}
    if name not in known:
        raise InputError(
            f"unknown recipe {shorten(name)}; those that come with flcav: {', '.join(known)}{suggest(name, known)}"
        )
    return known[name]


def find_recipe(path: Path) -> Path:
    """Return `path`, or the packaged recipe if `path` is "recipes/NAME.yaml" and no such file exists."""
    if path.parts[:1] != ("recipes",) or path.suffix != ".yaml" or path.exists():
        return path
    try:
        return recipe_path(path.relative_to("recipes").with_suffix("").as_posix())
    except InputError:
        return path


def parse_recipe(values: Mapping[str, Json], origin: str) -> Recipe:
    """Parse the fields `values` as a recipe, a `CarlaRecipe` if they have a `source`: see `parse_config`."""
    return parse_config(_choose_model(values), values, origin)


def _choose_model(values: object) -> type[Recipe]:
    return CarlaRecipe if isinstance(values, dict) and "source" in values else Recipe


def load_recipe(path: Path | str) -> Recipe:
    """Load the recipe in the YAML file at `path`, a `CarlaRecipe` if it has a `source`: see docs/recipes.md.

    The field `town` becomes an absolute path where it names a folder next to the file. Raises `InputError`, which names
    file, field, value and violated rule.

    >>> from flcav import load_recipe
    >>> load_recipe("recipes/suburb.yaml").town
    'suburb'
    """
    values = read_yaml(Path(path))
    recipe = parse_config(_choose_model(values), values, str(path))
    folder = Path(path).absolute().parent / recipe.town
    if recipe.town in PACKAGED or not os.path.isdir(folder):  # noqa: PTH112 - Path.is_dir raises for too long a name
        return recipe
    return recipe.model_copy(update={"town": str(folder)})


class DividedSource:
    """Base of sources that divide a recipe's frames into scenes: a scene has the frames of all agents at all spins."""

    def __init__(self, recipe: Recipe, town: str, agents: tuple[str, ...]) -> None:
        """Raise `InputError` where there is no agent, or the town's name is too long for the names of frames."""
        if not agents:
            raise InputError("fields 'cavs' = 0 and 'poles' = []: nobody observes; give at least one of them")
        self._name = f"{town}-{recipe.seed}"
        self._per_scene = recipe.spins * len(agents)
        self.frame_total = recipe.frames or recipe.scenes * self._per_scene
        longest = max((format_key(self.scenes()[-1], recipe.spins - 1, one) for one in agents), key=len)
        if len(longest) > LONGEST_NAME:
            raise InputError(
                f"field 'town' = {shorten(recipe.town)}: a frame would be called {shorten(longest)}, {len(longest)} "
                f"characters where {LONGEST_NAME} are allowed; give the town's folder a shorter name"
            )

    def scenes(self) -> list[str]:
        """Return the names of the scenes, `<town>-<seed>-<number>`."""
        return [f"{self._name}-{scene:03d}" for scene in range(-(-self.frame_total // self._per_scene))]

    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a scene; the last scene has fewer where the recipe limits frames.

        With `window_range_m` it is the largest number: how many are recorded depends on the traffic.
        """
        return min(self._per_scene, self.frame_total - self.scenes().index(scene) * self._per_scene)
