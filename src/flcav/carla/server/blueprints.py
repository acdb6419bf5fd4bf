"""Blueprints: the actors that can be spawned, and the check of a client's description of one."""

from dataclasses import dataclass
from functools import cache
from zlib import crc32

from flcav.carla.server import catalogue, wire
from flcav.carla.server.catalogue import BOOL, COLOUR, FLOAT, INT, STRING, Field, Quality
from flcav.config import shorten
from flcav.interface.wording import suggest
from flcav.world.map.parameters import CLUTTER
from flcav.world.shapes import SHAPES

COLOURS = ("17,37,103", "107,18,14", "180,180,180", "25,25,25", "230,230,230")
TRUE = ("true", "1")
GAMMA = 2.2  # of sRGB, about
LARGEST_INT = 2**31


class Refused(ValueError):
    """The error of a call that cannot be carried out; its text is the reply."""


@dataclass(frozen=True)
class Blueprint:
    """Something that can be spawned."""

    definition: wire.Definition
    fields: dict[str, Field]  # the limits of a sensor's attributes
    category: str = ""  # of the town's actors, or "prop"; empty for what has no body
    shape: int = 0  # its row among those
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)  # length, width, height [m]

    @property
    def kind(self) -> str:
        """The first part of its name: vehicle, walker, static, sensor or controller."""
        return self.definition.id.partition(".")[0]


@cache
def list_blueprints(quality: Quality = Quality.HIGH) -> dict[str, Blueprint]:
    """Return all blueprints by name; below high quality colour cameras have an attribute of that name."""
    found: list[Blueprint] = []

    def add(name: str, variations: list[wire.Variation], fields: dict[str, Field] | None = None, **body) -> None:
        definition = wire.Definition(len(found) + 1, name, ",".join(sorted(name.split("."))), tuple(variations))
        found.append(Blueprint(definition, fields or {}, **body))

    for name, body in catalogue.VEHICLES.items():
        add(
            f"vehicle.{name}",
            _vehicle(name, body),
            category=body.category,
            shape=[shape.name for shape in SHAPES[body.category]].index(body.shape),
            size=_full(body.extent),
        )
    shapes = [shape.name for shape in SHAPES["pedestrian"]]
    for number in range(1, catalogue.WALKERS + 1):
        kind = "child" if number in catalogue.CHILDREN else "tall"
        add(
            f"walker.pedestrian.{number:04d}",
            _walker(number, kind),
            category="pedestrian",
            shape=shapes.index(kind),
            size=_full(catalogue.WALKER_SIZES[kind]),
        )
    add("controller.ai.walker", [_free("role_name", STRING, "default")])
    for name, fields in (catalogue.SENSORS | catalogue.OTHERS | catalogue.NOT_SERVED).items():
        told = [_free("role_name", STRING, "front"), _free("ros_name", STRING, name)]
        if name == "sensor.camera.rgb" and quality != Quality.HIGH:
            told.append(wire.Variation("quality", STRING, quality, tuple(Quality), True, True))
        add(name, [*(_free(key, field.type, field.default) for key, field in fields.items()), *told], fields)
    clutter = list(CLUTTER)
    for name, (kind, extent) in catalogue.PROPS.items():
        variations = [_fixed("size", STRING, "medium"), _free("role_name", STRING, "prop")]
        add(f"static.prop.{name}", variations, category="prop", shape=clutter.index(kind), size=_full(extent))
    return {blueprint.definition.id: blueprint for blueprint in found}


def check(description: wire.Description, quality: Quality = Quality.HIGH) -> tuple[Blueprint, wire.Description]:
    """Return the blueprint of a description and the description with all attributes; raises `Refused`."""
    known = list_blueprints(quality)
    blueprint = known.get(description.id)
    if blueprint is None:
        raise Refused(f"no blueprint {shorten(description.id)}{suggest(description.id, known)}")
    if description.id in catalogue.NOT_SERVED:
        served = f"; sensors are {', '.join(catalogue.SENSORS)}" if blueprint.kind == "sensor" else ""
        raise Refused(f"{description.id} is not served here{served}")
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
        raise Refused(f"{name}: attribute '{variation.id}' = {shorten(value)} is not {allowed}")
    if variation.type in (INT, FLOAT):
        low, high = (field.low, field.high) if field else (-LARGEST_INT, LARGEST_INT)
        try:
            number = float(value)  # of whole numbers too: CARLA takes "64.0" for 64
        except ValueError:
            raise Refused(f"{name}: attribute '{variation.id}' = {shorten(value)} is no number") from None
        if not low <= number <= high:
            raise Refused(f"{name}: attribute '{variation.id}' = {value} is not within {low:g} and {high:g}")
    elif variation.type == COLOUR and not _is_colour(value):
        raise Refused(f"{name}: attribute '{variation.id}' = {shorten(value)} is no colour, such as 255,0,0")
    elif variation.type == BOOL and value.lower() not in (*TRUE, "false", "0"):
        raise Refused(f"{name}: attribute '{variation.id}' = {shorten(value)} is neither true nor false")


def find_paint(description: wire.Description) -> wire.Vector | None:
    """Return the linear RGB of the attribute "color" of a checked description, of sRGB; None where it has none."""
    told = next((each.value for each in description.attributes if each.type == COLOUR), None)
    if told is None:
        return None
    red, green, blue = ((int(part) / 255) ** GAMMA for part in told.split(","))
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


def _vehicle(name: str, body: catalogue.Body) -> list[wire.Variation]:
    two = body.category in ("motorcycle", "bicycle")
    told = [
        _free("role_name", STRING, "autopilot", "scenario", "ego_vehicle"),
        _free("ros_name", STRING, f"vehicle.{name}"),
        _free("sticky_control", BOOL, "true"),
        _free("terramechanics", BOOL, "false"),
        _fixed("object_type", STRING, ""),
        _fixed("base_type", STRING, body.category),
        _fixed("special_type", STRING, body.special),
        _fixed("generation", INT, str(body.generation)),
        _fixed("number_of_wheels", INT, "2" if two else "4"),
        _fixed("has_lights", BOOL, "false" if body.category == "bicycle" else "true"),
        _fixed("has_dynamic_doors", BOOL, "false"),
    ]
    first = crc32(name.encode()) % len(COLOURS)  # makes differ where clients choose none
    told.append(_free("color", COLOUR, *COLOURS[first:], *COLOURS[:first]))
    if two:
        told.append(_free("driver_id", INT, "0"))
    return told


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
