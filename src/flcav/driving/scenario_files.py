"""Driving scenarios from files: recipes of recordings, recordings, user-defined scenarios in YAML, and OpenSCENARIO.

A recipe gives a scenario for each of its corner cases, at its place and in its weather; `flcav odd sample` writes such
recipes. A user-defined scenario has the fields of `ScenarioFile`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pydantic import Field

from flcav.config import Config, InputError, parse_config, read_yaml
from flcav.dataset.layout import MANIFEST, read_manifest
from flcav.driving.openscenario import read_openscenario
from flcav.driving.scenarios import DrivingScenario, Event, find_scenarios
from flcav.sources.recipe import CarlaRecipe, Recipe, parse_recipe
from flcav.statistics.streams import stream
from flcav.world.map.town import PACKAGED, load_town
from flcav.world.scenarios.scenario import Kind
from flcav.world.weather import WEATHERS, WeatherSchedule

TRAFFIC, PEDESTRIANS = 25, 8  # as in the scenarios of the package
ENDINGS = (".yaml", ".yml", ".xosc")


class ScenarioFile(Config):
    """A driving scenario of one's own: where, in which weather and traffic, and what happens."""

    town: str  # name of a town of flcav, or folder of an imported one
    event: Event = "none"  # somebody steps out, a car is broken down, or the car ahead brakes
    case: Kind | None = None  # corner case of recordings that happens
    place: tuple[float, float] | None = None  # x, y that the route passes by, 40 m from its start [m]
    weather: WeatherSchedule = WeatherSchedule.model_validate(WEATHERS["clear"])  # as in a recipe
    traffic: int = Field(default=TRAFFIC, ge=0, le=500)  # vehicles around
    pedestrians: int = Field(default=PEDESTRIANS, ge=0, le=500)  # pedestrians around


def read_scenarios(names: Sequence[str]) -> tuple[DrivingScenario, ...]:
    """Return the scenarios of these names, files and folders; without any, all scenarios of the package.

    Raises `InputError` for an unknown name, a file that is no scenario, and a scenario that is given twice.
    """
    if not names:
        return find_scenarios(())
    scenarios = [scenario for name in names for scenario in _read_one(name)]
    counts: dict[str, int] = {}
    for scenario in scenarios:
        counts[scenario.name] = counts.get(scenario.name, 0) + 1
    if twice := [name for name, count in counts.items() if count > 1]:
        raise InputError(f"--scenario {twice[0]}: given twice")
    return tuple(scenarios)


def _read_one(name: str) -> tuple[DrivingScenario, ...]:
    path = Path(name)
    if path.is_dir():
        return _read_recording(path)
    if path.suffix.lower() not in ENDINGS and not path.is_file():
        return find_scenarios([name])
    if path.suffix.lower() not in ENDINGS:
        raise InputError(
            f"{path}: a scenario is a YAML file (.yaml) or OpenSCENARIO (.xosc), or the folder of a recording"
        )
    called = f"{path.resolve().parent.name}/{path.stem}"
    if path.suffix.lower() == ".xosc":
        return (read_openscenario(path, f"{called}.xosc"),)
    values = read_yaml(path)
    if (
        isinstance(values, dict)
        and {"event", "case", "place", "traffic", "pedestrians"} & set(values)
        and "source" not in values
    ):
        return (_make_scenario(parse_config(ScenarioFile, values, str(path)), called, path.parent),)
    if not isinstance(values, dict):
        raise InputError(f"{path}: a scenario is a mapping, with a town")
    return _list_cases(parse_recipe(values, str(path)), called, path.parent, path)


def _read_recording(folder: Path) -> tuple[DrivingScenario, ...]:
    if not (folder / MANIFEST).is_file():
        raise InputError(
            f"{folder}: no recording, since it has no {MANIFEST}; name its recipes, such as {folder}/1.yaml"
        )
    manifest = read_manifest(folder)
    if manifest.imported or "town" not in manifest.recipe:
        raise InputError(f"{folder}: was not recorded in a town of flcav, so that nobody can drive there")
    known = {name: value for name, value in manifest.recipe.items() if name in Recipe.model_fields or name == "source"}
    return _list_cases(parse_recipe(known, str(folder)), folder.resolve().name, folder, folder)


def _make_scenario(file: ScenarioFile, name: str, folder: Path) -> DrivingScenario:
    plain = DrivingScenario(name, _find_town(file.town, folder), file.event, "clear", file.traffic, file.pedestrians)
    sky = file.weather.draw(stream(0, "weather", name)).at(0.0)
    return replace(plain, case=file.case, place=file.place).with_sky(sky)


def _list_cases(recipe: Recipe, name: str, folder: Path, origin: Path) -> tuple[DrivingScenario, ...]:
    """Return a scenario for each corner case of a recipe; a recipe without corner cases gives one without events."""
    if isinstance(recipe, CarlaRecipe):
        raise InputError(f"{origin}: is recorded in CARLA; flcav drives in its own towns")
    town = _find_town(recipe.town, folder)
    plain = DrivingScenario(name, town, "none", "clear", TRAFFIC, PEDESTRIANS)
    schedule = recipe.weather.draw(stream(recipe.seed, "weather", name))
    if not recipe.scenarios:
        return (plain.with_sky(schedule.at(0.0)),)
    first_s = recipe.warmup_steps[0] / 10
    scenarios = []
    for number, case in enumerate(recipe.scenarios, start=1):
        called = name if len(recipe.scenarios) == 1 else f"{name}-{number}"
        placed = replace(plain, name=called, case=case.kind, place=case.position)
        scenarios.append(placed.with_sky(schedule.at(max(case.at_s - first_s, 0.0))))
    return tuple(scenarios)


def _find_town(name: str, parent: Path) -> str:
    """Return the name of a town of flcav, or the folder of an imported one; raises `InputError` for neither."""
    folder = parent / name
    known = name if name in PACKAGED or not folder.is_dir() else str(folder.resolve())
    load_town(known)
    return known
