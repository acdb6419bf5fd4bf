"""Blueprints: the actors that can be spawned with their attributes, and the check of a client's description of one.

Names, attributes and their defaults are those of CARLA 0.9.16's documentation, "Blueprint library" and "Sensors
reference". The table `bodies.csv` has the bodies that stand for vehicles and props here: half extents are those of
CARLA's bounding boxes, but for the widths of two-wheelers, which CARLA makes too narrow or 0.
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
    """How colour images are drawn where clients do not choose."""

    HIGH = "high"
    LOW = "low"  # with a quarter of the rays: half of the columns and rows, between which colours are interpolated


class Body(NamedTuple):
    """What stands for a blueprint of a vehicle or prop: a shape of the town's actors, scaled to a size."""

    category: str  # of `flcav.world.shapes`, or "prop"
    shape: str  # its name among those of the category, of a prop among `CLUTTER`
    extent: tuple[float, float, float]  # half of length, width, height [m]
    generation: str
    special: str  # CARLA's special_type


def _read_bodies() -> dict[str, Body]:
    with (Path(__file__).parent / "bodies.csv").open(newline="", encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    return {
        name: Body(*kind, (float(x), float(y), float(z)), generation, special)
        for name, *kind, x, y, z, generation, special in rows
    }


BODIES = _read_bodies()  # by blueprint
CHILDREN = frozenset({9, 10, 11, 12, 13, 14, 48, 49})  # numbers of walkers
WALKERS = 52
WALKER_SIZES: dict[str, tuple[float, float, float]] = {  # shape -> half extents [m]
    "tall": (0.188, 0.188, 0.93),
    "child": (0.188, 0.188, 0.65),
}
BOOL, INT, FLOAT, STRING, COLOUR = 1, 2, 3, 4, 5


class Field(NamedTuple):
    """An attribute of a kind of sensor: its default, and the values that are served."""

    type: int
    default: str
    low: float = -1e6
    high: float = 1e6


def _number(default: float, low: float = -1e6, high: float = 1e6) -> Field:
    return Field(FLOAT, str(default), low, high)


def _whole(default: int, low: int, high: int) -> Field:
    return Field(INT, str(default), low, high)


_TICK = {"sensor_tick": _number(0.0, 0.0, 1e4), "noise_seed": _whole(0, -(2**31), 2**31 - 1)}
_LENS = {
    "image_size_x": _whole(800, 16, 4096),
    "image_size_y": _whole(600, 16, 4096),
    "fov": _number(90.0, 1.01, 169.0),
    "sensor_tick": _number(0.0, 0.0, 1e4),
    "lens_circle_falloff": _number(5.0),
    "lens_circle_multiplier": _number(0.0),
    "lens_k": _number(-1.0),
    "lens_kcube": _number(0.0),
    "lens_x_size": _number(0.08),
    "lens_y_size": _number(0.08),
}
_RGB = {
    "bloom_intensity": _number(0.675),
    "lens_flare_intensity": _number(0.1),
    "enable_postprocess_effects": Field(BOOL, "true"),
    "gamma": _number(2.2),
    "exposure_mode": Field(STRING, "histogram"),
    "exposure_compensation": _number(0.0),
    "exposure_min_bright": _number(10.0),
    "exposure_max_bright": _number(12.0),
    "exposure_speed_up": _number(3.0),
    "exposure_speed_down": _number(1.0),
    "calibration_constant": _number(16.0),
    "iso": _number(100.0),
    "fstop": _number(1.4),
    "shutter_speed": _number(200.0),
    "min_fstop": _number(1.2),
    "blade_count": _whole(5, 0, 100),
    "focal_distance": _number(1000.0),
    "blur_amount": _number(1.0),
    "blur_radius": _number(0.0),
    "motion_blur_intensity": _number(0.45),
    "motion_blur_max_distortion": _number(0.35),
    "motion_blur_min_object_screen_size": _number(0.1),
    "slope": _number(0.88),
    "toe": _number(0.55),
    "shoulder": _number(0.26),
    "black_clip": _number(0.0),
    "white_clip": _number(0.04),
    "temp": _number(6500.0),
    "tint": _number(0.0),
    "chromatic_aberration_intensity": _number(0.0),
    "chromatic_aberration_offset": _number(0.0),
}
_SPIN = {
    "channels": _whole(32, 1, 512),
    "range": _number(10.0, 0.1, 1e5),
    "points_per_second": _whole(56000, 1, 20_000_000),
    "rotation_frequency": _number(10.0, 0.01, 1000.0),
    "upper_fov": _number(10.0, -90.0, 90.0),
    "lower_fov": _number(-30.0, -90.0, 90.0),
    "horizontal_fov": _number(360.0, 0.1, 360.0),
    "sensor_tick": _number(0.0, 0.0, 1e4),
    "lidar_type": Field(STRING, "default"),  # this and the next one are those of builds of CARLA with more LiDARs
    "name": Field(STRING, "lidar"),
}
SENSORS: dict[str, dict[str, Field]] = {
    "sensor.camera.rgb": _LENS | _RGB,
    "sensor.camera.depth": _LENS,
    "sensor.camera.semantic_segmentation": _LENS,
    "sensor.camera.instance_segmentation": _LENS,
    "sensor.lidar.ray_cast": _SPIN
    | {
        "atmosphere_attenuation_rate": _number(0.004, 0.0, 10.0),
        "dropoff_general_rate": _number(0.45, 0.0, 1.0),
        "dropoff_intensity_limit": _number(0.8, 0.0, 1.0),
        "dropoff_zero_intensity": _number(0.4, 0.0, 1.0),
        "noise_stddev": _number(0.0, 0.0, 100.0),
        "noise_seed": _TICK["noise_seed"],
    },
    "sensor.lidar.ray_cast_semantic": _SPIN,
    "sensor.other.collision": {},
    "sensor.other.gnss": _TICK
    | {
        f"noise_{axis}_{kind}": _number(0.0, -1e3 if kind == "bias" else 0.0, 1e3)
        for axis in ("alt", "lat", "lon")
        for kind in ("bias", "stddev")
    },
    "sensor.other.imu": _TICK
    | {f"noise_{kind}_stddev_{axis}": _number(0.0, 0.0, 1e3) for kind in ("accel", "gyro") for axis in "xyz"}
    | {f"noise_gyro_bias_{axis}": _number(0.0, -1e3, 1e3) for axis in "xyz"},
    "sensor.other.lane_invasion": {},
    "sensor.other.obstacle": {
        "distance": _number(5.0, 0.0, 1000.0),
        "hit_radius": _number(0.5, 0.0, 10.0),
        "only_dynamics": Field(BOOL, "False"),
        "debug_linetrace": Field(BOOL, "False"),
        "sensor_tick": _TICK["sensor_tick"],
    },
    "sensor.other.radar": _TICK
    | {
        "horizontal_fov": _number(30.0, 0.0, 180.0),
        "vertical_fov": _number(30.0, 0.0, 180.0),
        "points_per_second": _whole(1500, 1, 1_000_000),
        "range": _number(100.0, 0.1, 1e5),
    },
}
_RADIO = {
    "transmit_power": _number(21.5),
    "receiver_sensitivity": _number(-99.0),
    "frequency_ghz": _number(5.9),
    "noise_seed": _TICK["noise_seed"],
    "path_loss_exponent": _number(2.7),
    "d_ref": _number(1.0),
    "filter_distance": _number(500.0),
    "combined_antenna_gain": _number(10.0),
    "use_etsi_fading": Field(BOOL, "true"),
    "custom_fading_stddev": _number(0.0),
    "scenario": Field(STRING, "highway"),
    "path_loss_model": Field(STRING, "geometric"),
}
_CAM = (
    {"gen_cam_min": _number(0.1), "gen_cam_max": _number(1.0), "fixed_rate": Field(BOOL, "false")}
    | {f"noise_accel_stddev_{axis}": _number(0.0) for axis in "xyz"}
    | {f"noise_{kind}_{part}": _number(0.0) for kind in ("yawrate", "head") for part in ("stddev", "bias")}
    | {f"noise_{axis}_{part}": _number(0.0) for axis in ("alt", "lat", "lon") for part in ("stddev", "bias")}
    | {"noise_vel_stddev_x": _number(0.0)}
)
# What is neither a body nor a sensor: an actor that nobody sees, and a box in which tyres hold by another friction.
TRIGGER = "static.trigger.friction"
OTHERS: dict[str, dict[str, Field]] = {
    "util.actor.empty": {},
    TRIGGER: {f"extent_{axis}": _number(1.0, 0.0, 1e8) for axis in "xyz"}
    | {"friction": _number(3.5, 0.0, 100.0)},  # [cm]
}
# Blueprints of CARLA that are listed, so that scripts find them, and refused when one is to be spawned.
NOT_SERVED: dict[str, dict[str, Field]] = {
    "sensor.camera.dvs": _LENS,
    "sensor.camera.normals": _LENS,
    "sensor.camera.optical_flow": _LENS,
    "sensor.other.rss": {},
    "sensor.camera.cosmos_visualization": _LENS,
    "sensor.other.v2x": _RADIO | _CAM | {"sensor_tick": _TICK["sensor_tick"]},
    "sensor.other.v2x_custom": _RADIO | {"sensor_tick": _TICK["sensor_tick"]},
    "static.prop.mesh": {"mesh_path": Field(STRING, ""), "scale": _number(1.0), "mass": _number(0.0)},
}


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

    def add_body(name: str, variations: list[wire.Variation], body: Body) -> None:
        shapes = [*CLUTTER] if body.category == "prop" else [shape.name for shape in SHAPES[body.category]]
        add(name, variations, category=body.category, shape=shapes.index(body.shape), size=_full(body.extent))

    for name, body in BODIES.items():
        if body.category != "prop":
            add_body(name, _vehicle(name, body), body)
    for number in range(1, WALKERS + 1):
        kind = "child" if number in CHILDREN else "tall"
        body = Body("pedestrian", kind, WALKER_SIZES[kind], "", "")
        add_body(f"walker.pedestrian.{number:04d}", _walker(number, kind), body)
    add("controller.ai.walker", [_free("role_name", STRING, "default")])
    for name, fields in (SENSORS | OTHERS | NOT_SERVED).items():
        told = [_free("role_name", STRING, "front"), _free("ros_name", STRING, name)]
        if name == "sensor.camera.rgb" and quality != Quality.HIGH:
            told.append(wire.Variation("quality", STRING, quality, tuple(Quality), True, True))
        add(name, [*(_free(key, field.type, field.default) for key, field in fields.items()), *told], fields)
    for name, body in BODIES.items():
        if body.category == "prop":
            add_body(name, [_fixed("size", STRING, "medium"), _free("role_name", STRING, "prop")], body)
    return {blueprint.definition.id: blueprint for blueprint in found}


def check(description: wire.Description, quality: Quality = Quality.HIGH) -> tuple[Blueprint, wire.Description]:
    """Return the blueprint of a description and the description with all attributes; raises `Refused`."""
    known = list_blueprints(quality)
    blueprint = known.get(description.id)
    if blueprint is None:
        raise Refused(f"no blueprint {shorten(description.id)}{suggest(description.id, known)}")
    if description.id in NOT_SERVED:
        served = f"; sensors are {', '.join(SENSORS)}" if blueprint.kind == "sensor" else ""
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


def _vehicle(name: str, body: Body) -> list[wire.Variation]:
    two = body.category in ("motorcycle", "bicycle")
    told = [
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
