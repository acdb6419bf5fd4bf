"""Write docs/recipes.md from the models of recipes and the comments of their fields: python tools/recipes_page.py."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from pydantic.fields import FieldInfo

from flcav.config import Config
from flcav.interface.fields import written_fields
from flcav.sensors.camera import Camera
from flcav.sensors.infrared import Infrared
from flcav.sensors.lens import Lens
from flcav.sensors.lidar.beams import BEAMS
from flcav.sensors.lidar.lidar import CarlaReturns, Lidar
from flcav.sensors.navigation import Gnss, Imu
from flcav.sensors.radar import Radar
from flcav.sensors.rig import (
    RIGS,
    CalibrationError,
    Mount,
    Mounted,
    MountedCamera,
    MountedGnss,
    MountedImu,
    MountedInfrared,
    MountedLidar,
    MountedRadar,
    Rig,
)
from flcav.sources.recipe import CarlaRecipe, Recipe
from flcav.storage.markdown import format_table
from flcav.world.map.town import PACKAGED
from flcav.world.scenarios.scenario import Scenario
from flcav.world.weather import WEATHER_CLASSES, WEATHERS, Keyframe, Weather, WeatherSchedule

PAGE = Path(__file__).parents[1] / "docs" / "recipes.md"
TEMPLATE = Path(__file__).with_name("recipes.md.j2")
HEADER = ("field", "value", "default", "description")
UNITS = {  # by suffix of a field's name
    **{"mm_h": "mm/h", "m_s": "m/s", "ms": "ms", "m": "m", "s": "s"},
    **{"deg": "°", "rad": "rad", "px": "px", "hz": "Hz", "k": "K"},
}
SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
LARGEST = 2**63  # limit of a seed, which is not mentioned
WORDS = {int: "whole number", float: "number", bool: "true, false", str: "text"}
LISTS = {int: "whole numbers", float: "numbers", str: "names"}
LINKS: Mapping[type[Config], str] = {  # to the section on a model
    Rig: "[rig](#rigs)",
    Mount: "[pose](#rigs)",
    MountedLidar: "[LiDARs](#lidar)",
    MountedCamera: "[cameras](#cameras)",
    MountedInfrared: "[thermal cameras](#cameras)",
    MountedRadar: "[radars](#radar)",
    MountedGnss: "[receivers](#gnss)",
    MountedImu: "[units](#imu)",
    CarlaReturns: "[values](#lidar)",
    WeatherSchedule: "[weather](#weather)",
    Weather: "[weather](#weather)",
    Keyframe: "[keyframes](#weather)",
    CalibrationError: "[errors](#errors-of-calibration)",
    Scenario: "[corner cases](#corner-cases)",
}
EXPLAINED = (
    *(Recipe, CarlaRecipe, Rig, Mounted, Mount, Lidar, CarlaReturns, Lens, Camera, Infrared, Radar, Gnss, Imu),
    *(Weather, WeatherSchedule, Keyframe, CalibrationError, Scenario),
)


def page() -> str:
    """Return the page as Markdown."""
    jinja = Environment(loader=FileSystemLoader(TEMPLATE.parent), undefined=StrictUndefined, keep_trailing_newline=True)
    weathers, values = WEATHERS.items(), Weather.model_fields
    return jinja.get_template(TEMPLATE.name).render(
        {model.__name__: model for model in EXPLAINED},
        fields=fields_of,
        towns=", ".join(f"`{name}`" for name in PACKAGED),
        rigs=format_table(
            ("rig", "its sensors"), ((f"`{name}`", "; ".join(sensors_of(rig))) for name, rig in RIGS.items())
        ),
        beams=format_table(("`beams`", "beams", "elevations", "`azimuth_steps`", "`range_m`"), beams()),
        presets=WEATHERS,
        preset_table=format_table(
            ("preset", *(f"`{name}`" for name in values)),
            ((f"`{preset}`", *(number(getattr(weather, name)) for name in values)) for preset, weather in weathers),
        ),
        class_table=format_table(
            ("class", "region"), ((f"`{name}`", "; ".join(region(name))) for name in WEATHER_CLASSES)
        ),
    )


def fields_of(model: type[Config], without: type[Config] = Config) -> str:
    """Return a format_table of the model's fields, without those of `without`."""
    said = comments(model)
    rows = []
    for name, field in model.model_fields.items():
        if name not in without.model_fields:
            text, unit = said_and_unit(name, said[name])
            rows.append((f"`{name}`", value_of(field) + (f" [{unit}]" if unit else ""), default_of(field), text))
    return format_table(HEADER, rows)


def comments(model: type[Config]) -> dict[str, str]:
    """Return the comment beside each field of a model, those it inherits included."""
    return {name: field.comment for name, field in written_fields(model).items()}


def said_and_unit(name: str, comment: str) -> tuple[str, str]:
    """Return a field's comment without its unit, and the unit: from brackets in the comment, or the name's suffix."""
    if bracket := re.search(r" *\[([^\]]*[a-z][^\]]*)\]", comment):
        return comment.replace(bracket[0], ""), bracket[1]
    return comment, next((unit for ending, unit in UNITS.items() if name.endswith(f"_{ending}")), "")


def value_of(field: FieldInfo) -> str:
    """Return type and limits of a field's values in words."""
    return kind_of(field.annotation) + limits_of(field.metadata)


def limits_of(metadata: Iterable[Any]) -> str:
    """Return the limits of a number in words."""
    limits = {name: getattr(each, name) for each in metadata for name in SIGNS if hasattr(each, name)}
    if {*limits} == {"ge", "le"}:
        return f", {number(limits['ge'])} to {number(limits['le'])}"
    return "".join(f", {SIGNS[name]} {number(limit)}" for name, limit in limits.items() if limit != LARGEST)


def kind_of(annotation: Any) -> str:
    """Return a type in words; of a model, a link to its section."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return kind_of(inner[0]) + "".join(limits_of(getattr(each, "metadata", ())) for each in inner[1:])
    if origin in (Union, UnionType):
        return " or ".join(kind_of(each) for each in inner if each is not NoneType)
    if origin is Literal:
        return ", ".join(f"`{each}`" for each in inner)
    if origin in (dict, Mapping):
        return f"by name: {kind_of(inner[1])}"
    if origin is tuple and inner[-1] is not Ellipsis:
        return f"{len(inner)} numbers"
    if origin is tuple:
        return f"list of {LISTS.get(inner[0]) or kind_of(inner[0])}"
    return WORDS.get(annotation) or LINKS[annotation]


def default_of(field: FieldInfo) -> str:
    """Return the default value of a field in YAML's notation."""
    if field.is_required():
        return "**required**"
    value = field.get_default(call_default_factory=True)
    names = {rig.model_dump_json(): name for name, rig in RIGS.items()}
    if isinstance(value, WeatherSchedule):
        return f"`{next(name for name, each in WEATHERS.items() if WeatherSchedule.model_validate(each) == value)}`"
    if isinstance(value, Rig):
        return f"`{names[value.model_dump_json()]}`"
    if isinstance(value, Config) or value is None or value in ((), {}):
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value if isinstance(value, str) else number(value)}`"


def sensors_of(rig: Rig) -> Iterator[str]:
    """Yield a description of each sensor of a rig."""
    for name, lidar in rig.lidars.items():
        settings = lidar.settings
        beams = settings.beams or f"{settings.channels} channels from {settings.up_deg:g}° to {settings.down_deg:g}°"
        yield f"LiDAR `{name}` ({beams}, {settings.azimuth_steps} steps, {settings.range_m:g} m)"
    for name, camera in rig.cameras.items():
        lens = camera.settings
        wide = 2 * np.degrees(np.arctan(lens.width / 2 / lens.intrinsics()[0, 0]))
        yield f"camera `{name}` ({lens.width} × {lens.height}, {wide:.0f}°)"
    yield from (f"thermal camera `{name}`" for name in rig.infrareds)
    yield from (f"radar `{name}`" for name in rig.radars)
    yield from (f"GNSS `{name}`" for name in rig.gnss)
    yield from (f"IMU `{name}`" for name in rig.imus)


def beams() -> Iterator[tuple[Any, ...]]:
    """Yield a format_table row for each named set of beams."""
    for name, known in BEAMS.items():
        high, low = max(known.elevations_deg), min(known.elevations_deg)
        limits = f"{high:g}° to {low:g}°"
        yield f"`{name}`", len(known.elevations_deg), limits, known.azimuth_steps, number(known.range_m)


def region(name: str) -> Iterator[str]:
    """Yield the limits of each parameter in a weather class."""
    for field, (low, high) in WEATHER_CLASSES[name].items():
        yield f"`{field}` {low:g}" + (f" to {high:g}" if high > low else "")


def number(value: Any) -> str:
    """Return a number with up to 12 significant digits."""
    return f"{value:.12g}"


if __name__ == "__main__":
    PAGE.write_text(page())
    print(PAGE)
