"""Blueprints: the actors that can be spawned, with their attributes, and the check of a client's actor description.

Names, attributes and their defaults are those of CARLA 0.9.16's documentation, "Blueprint library" and "Sensors
reference", in the table `attributes.csv`; numbers without limits must be within a million. The table `bodies.csv` maps
vehicles and props to shapes of flcav: half extents are those of CARLA's bounding boxes, except for the widths of
two-wheelers, which CARLA makes too narrow or 0.
"""

import csv
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from flcav.carla.server import wire
from flcav.config import shorten
from flcav.interface.wording import suggest
from flcav.world.map.parameters import CLUTTER
from flcav.world.shapes import SHAPES


class Quality(StrEnum):
    """Default rendering quality of colour images."""

    HIGH = "high"
    LOW = "low"  # a quarter of the rays: every second column and row, with interpolated colours between


class BodyShape(NamedTuple):
    """The body of a vehicle's or prop's blueprint: a shape of the town's actors, scaled to a size."""

    category: str  # of `flcav.world.shapes`, or "prop"
    shape: str  # its name among those of the category, of a prop among `CLUTTER`
    extent: tuple[float, float, float]  # half of length, width, height [m]
    generation: str  # CARLA's generation
    special: str  # CARLA's special_type


def _read_rows(name: str) -> list[dict[str, str]]:
    with (Path(__file__).parent / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _read_body(row: dict[str, str]) -> BodyShape:
    extent = float(row["half_length_m"]), float(row["half_width_m"]), float(row["half_height_m"])
    return BodyShape(row["category"], row["shape"], extent, row["generation"], row["special_type"])


BODIES = {row["blueprint"]: _read_body(row) for row in _read_rows("bodies.csv")}
CHILDREN = frozenset({9, 10, 11, 12, 13, 14, 48, 49})  # numbers of walkers
WALKERS = 52
WALKER_SIZES: dict[str, tuple[float, float, float]] = {  # shape -> half extents [m]
    "tall": (0.188, 0.188, 0.93),
    "child": (0.188, 0.188, 0.65),
}
BOOL, INT, FLOAT, STRING, COLOUR = 1, 2, 3, 4, 5
TYPES = {"bool": BOOL, "int": INT, "float": FLOAT, "string": STRING}


class Field(NamedTuple):
    """An attribute of a blueprint: its type, default, and range of served values."""

    type: int
    default: str
    low: float  # least value, in CARLA's unit of the attribute
    high: float  # largest value


def _read_fields(served: str) -> dict[str, dict[str, Field]]:
    """Return blueprint -> attribute -> field from the rows of `attributes.csv` with this value of `served`."""
    found: dict[str, dict[str, Field]] = {}
    for row in _read_rows("attributes.csv"):
        if row["served"] == served:
            fields = found.setdefault(row["blueprint"], {})
            if row["attribute"]:
                limits = float(row["low"] or -1e6), float(row["high"] or 1e6)
                fields[row["attribute"]] = Field(TYPES[row["type"]], row["default"], *limits)
    return found


SENSORS = _read_fields("sensor")
OTHERS = _read_fields("other")  # an invisible actor, and a trigger volume with another friction
NOT_SERVED = _read_fields("no")  # listed, so that scripts find them, but refused when spawned
TRIGGER = "static.trigger.friction"
COLOURS = ("17,37,103", "107,18,14", "180,180,180", "25,25,25", "230,230,230")
TRUE = ("true", "1")
GAMMA = 2.2  # of sRGB, about
LARGEST_INT = 2**31


class CallRefused(ValueError):
    """A call that cannot be carried out; the message is sent to the client."""


@dataclass(frozen=True)
class CarlaBlueprint:
    """A blueprint: a kind of actor that can be spawned."""

    definition: wire.Definition
    fields: dict[str, Field]  # types and ranges of a sensor's attributes
    category: str = ""  # of the town's actors, or "prop"; empty without a body
    shape: int = 0  # row among the shapes of the category
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)  # length, width, height [m]

    @property
    def kind(self) -> str:
        """The kind of actor, the first part of its name: vehicle, walker, static, sensor or controller."""
        return self.definition.id.partition(".")[0]


@cache
def list_blueprints(quality: Quality = Quality.HIGH) -> dict[str, CarlaBlueprint]:
    """Return all blueprints by name; below high quality, colour cameras have an attribute "quality"."""
    found: list[CarlaBlueprint] = []

    def add(name: str, variations: list[wire.Variation], fields: dict[str, Field] | None = None, **body) -> None:
        definition = wire.Definition(len(found) + 1, name, ",".join(sorted(name.split("."))), tuple(variations))
        found.append(CarlaBlueprint(definition, fields or {}, **body))

    def add_body(name: str, variations: list[wire.Variation], body: BodyShape) -> None:
        shapes = [*CLUTTER] if body.category == "prop" else [shape.name for shape in SHAPES[body.category]]
        add(name, variations, category=body.category, shape=shapes.index(body.shape), size=_full(body.extent))

    for name, body in BODIES.items():
        if body.category != "prop":
            add_body(name, _vehicle(name, body), body)
    for number in range(1, WALKERS + 1):
        kind = "child" if number in CHILDREN else "tall"
        body = BodyShape("pedestrian", kind, WALKER_SIZES[kind], "", "")
        add_body(f"walker.pedestrian.{number:04d}", _walker(number, kind), body)
    add("controller.ai.walker", [_free("role_name", STRING, "default")])
    for name, fields in (SENSORS | OTHERS | NOT_SERVED).items():
        common = [_free("role_name", STRING, "front"), _free("ros_name", STRING, name)]
        if name == "sensor.camera.rgb" and quality != Quality.HIGH:
            common.append(wire.Variation("quality", STRING, quality, tuple(Quality), True, True))
        add(name, [*(_free(key, field.type, field.default) for key, field in fields.items()), *common], fields)
    for name, body in BODIES.items():
        if body.category == "prop":
            add_body(name, [_fixed("size", STRING, "medium"), _free("role_name", STRING, "prop")], body)
    return {blueprint.definition.id: blueprint for blueprint in found}


def check_description(
    description: wire.Description, quality: Quality = Quality.HIGH
) -> tuple[CarlaBlueprint, wire.Description]:
    """Return the blueprint of a description, and the description completed with default attributes.

    Raises `CallRefused` for an unknown blueprint, one that is not served, and an invalid value.
    """
    known = list_blueprints(quality)
    blueprint = known.get(description.id)
    if blueprint is None:
        raise CallRefused(f"no blueprint {shorten(description.id)}{suggest(description.id, known)}")
    if description.id in NOT_SERVED:
        served = f"; sensors are {', '.join(SENSORS)}" if blueprint.kind == "sensor" else ""
        raise CallRefused(f"{description.id} is not served here{served}")
    given = {attribute.id: attribute for attribute in description.attributes}
    whole = []
    for variation in blueprint.definition.attributes:
        attribute = given.get(variation.id)
        value = attribute.value if attribute is not None and variation.modifiable else variation.value
        _check_value(description.id, variation, blueprint.fields.get(variation.id), value)
        whole.append(wire.Attribute(variation.id, variation.type, value))
    return blueprint, wire.Description(blueprint.definition.uid, description.id, tuple(whole))


def _check_value(name: str, variation: wire.Variation, field: Field | None, value: str) -> None:
    if variation.restricted and value not in variation.recommended:
        allowed = " or ".join(variation.recommended)
        raise CallRefused(f"{name}: attribute '{variation.id}' = {shorten(value)} is not {allowed}")
    if variation.type in (INT, FLOAT):
        low, high = (field.low, field.high) if field else (-LARGEST_INT, LARGEST_INT)
        try:
            number = float(value)  # of whole numbers too: CARLA takes "64.0" for 64
        except ValueError:
            raise CallRefused(f"{name}: attribute '{variation.id}' = {shorten(value)} is no number") from None
        if not low <= number <= high:
            raise CallRefused(f"{name}: attribute '{variation.id}' = {value} is not within {low:g} and {high:g}")
    elif variation.type == COLOUR and not _is_colour(value):
        raise CallRefused(f"{name}: attribute '{variation.id}' = {shorten(value)} is no colour, such as 255,0,0")
    elif variation.type == BOOL and value.lower() not in (*TRUE, "false", "0"):
        raise CallRefused(f"{name}: attribute '{variation.id}' = {shorten(value)} is neither true nor false")


def read_paint(description: wire.Description) -> wire.Vector | None:
    """Return the attribute "color" (sRGB) of a checked description as linear RGB in [0, 1]; None without one."""
    colour = next((attribute.value for attribute in description.attributes if attribute.type == COLOUR), None)
    if colour is None:
        return None
    red, green, blue = ((int(part) / 255) ** GAMMA for part in colour.split(","))
    return red, green, blue


def _is_colour(value: str) -> bool:
    parts = [part.strip() for part in value.split(",")]
    return len(parts) == 3 and all(part.isdecimal() and int(part) <= 255 for part in parts)


def _full(extent: tuple[float, float, float]) -> tuple[float, float, float]:
    return (2 * extent[0], 2 * extent[1], 2 * extent[2])


def _free(name: str, kind: int, value: str, *others: str) -> wire.Variation:
    return wire.Variation(name, kind, value, (value, *others), True, False)


def _fixed(name: str, kind: int, value: str) -> wire.Variation:
    return wire.Variation(name, kind, value, (), False, False)


def _vehicle(name: str, body: BodyShape) -> list[wire.Variation]:
    two = body.category in ("motorcycle", "bicycle")
    variations = [
        _free("role_name", STRING, "autopilot", "scenario", "ego_vehicle"),
        _free("ros_name", STRING, name),
        _free("sticky_control", BOOL, "true"),
        _free("terramechanics", BOOL, "false"),
        _fixed("object_type", STRING, ""),
        _fixed("base_type", STRING, body.category),
        _fixed("special_type", STRING, body.special),
        _fixed("generation", INT, body.generation),
        _fixed("number_of_wheels", INT, "2" if two else "4"),
        _fixed("has_lights", BOOL, "false" if body.category == "bicycle" else "true"),
        _fixed("has_dynamic_doors", BOOL, "false"),
    ]
    first = crc32(name.removeprefix("vehicle.").encode()) % len(COLOURS)  # makes differ where clients choose none
    variations.append(_free("color", COLOUR, *COLOURS[first:], *COLOURS[:first]))
    if two:
        variations.append(_free("driver_id", INT, "0"))
    return variations


def _walker(number: int, kind: str) -> list[wire.Variation]:
    return [
        _free("role_name", STRING, "pedestrian"),
        _free("ros_name", STRING, f"walker.pedestrian.{number:04d}"),
        _free("is_invincible", BOOL, "true"),
        wire.Variation("speed", FLOAT, "0.0", ("0.0", "1.4", "2.8"), True, False),
        _fixed("gender", STRING, "female" if number % 2 else "male"),
        _fixed("age", STRING, "child" if kind == "child" else "adult"),
        _fixed("generation", INT, "2" if number > 14 else "1"),
        _free("can_use_wheelchair", BOOL, "false"),
        _free("use_wheelchair", BOOL, "false"),
    ]
