"""The catalogue of blueprints: names and attributes of CARLA 0.9.16, with the bodies that stand for them here.

Source of names, attributes and their defaults: CARLA 0.9.16's documentation, "Blueprint library" and "Sensors
reference". Half extents are those of CARLA's bounding boxes, but for the widths of two-wheelers, which CARLA makes too
narrow or 0.
"""

from enum import StrEnum
from typing import NamedTuple


class Quality(StrEnum):
    """How colour images are drawn where clients do not choose."""

    HIGH = "high"
    LOW = "low"  # with a quarter of the rays: half of the columns and rows, between which colours are interpolated


class Body(NamedTuple):
    """What stands for a blueprint: a row of `flcav.world.shapes`, scaled to a size."""

    category: str
    shape: str  # name
    extent: tuple[float, float, float]  # half of length, width, height [m]
    generation: int = 1
    special: str = ""  # CARLA's special_type


VEHICLES: dict[str, Body] = {
    "audi.a2": Body("car", "hatchback", (1.853, 0.894, 0.774)),
    "audi.etron": Body("car", "suv", (2.428, 1.017, 0.825)),
    "audi.tt": Body("car", "coupe", (2.091, 0.997, 0.693)),
    "bh.crossbike": Body("bicycle", "sport_bike", (0.744, 0.31, 0.89)),
    "bmw.grandtourer": Body("car", "minivan", (2.306, 1.121, 0.834)),
    "carlamotors.carlacola": Body("truck", "box_truck", (2.602, 1.314, 1.234)),
    "carlamotors.european_hgv": Body("truck", "box_truck", (3.967, 1.446, 1.733), 2),
    "carlamotors.firetruck": Body("truck", "box_truck", (4.234, 1.446, 1.914), 2, "emergency"),
    "chevrolet.impala": Body("car", "sedan", (2.679, 1.017, 0.705)),
    "citroen.c3": Body("car", "hatchback", (1.994, 0.926, 0.809)),
    "diamondback.century": Body("bicycle", "city_bike", (0.821, 0.31, 0.89)),
    "dodge.charger_2020": Body("car", "sedan", (2.503, 1.049, 0.767), 2),
    "dodge.charger_police": Body("car", "sedan", (2.487, 1.019, 0.775), 1, "emergency"),
    "dodge.charger_police_2020": Body("car", "sedan", (2.619, 1.049, 0.819), 2, "emergency"),
    "ford.ambulance": Body("van", "high_van", (3.183, 1.176, 1.216), 2, "emergency"),
    "ford.crown": Body("car", "taxi", (2.683, 0.900, 0.787), 2, "taxi"),
    "ford.mustang": Body("car", "coupe", (2.359, 0.947, 0.651)),
    "gazelle.omafiets": Body("bicycle", "city_bike", (0.919, 0.31, 0.90)),
    "harley-davidson.low_rider": Body("motorcycle", "roadster", (1.178, 0.382, 0.81)),
    "jeep.wrangler_rubicon": Body("car", "suv", (1.933, 0.953, 0.939)),
    "kawasaki.ninja": Body("motorcycle", "roadster", (1.017, 0.401, 0.80)),
    "lincoln.mkz_2017": Body("car", "sedan", (2.451, 1.064, 0.755)),
    "lincoln.mkz_2020": Body("car", "sedan", (2.446, 0.918, 0.746), 2),
    "mercedes.coupe": Body("car", "coupe", (2.513, 1.076, 0.825)),
    "mercedes.coupe_2020": Body("car", "coupe", (2.337, 1.001, 0.721), 2),
    "mercedes.sprinter": Body("van", "panel_van", (2.958, 0.994, 1.280), 2),
    "micro.microlino": Body("car", "city", (1.104, 0.741, 0.688)),
    "mini.cooper_s": Body("car", "city", (1.903, 0.985, 0.738)),
    "mini.cooper_s_2021": Body("car", "city", (2.276, 1.049, 0.884), 2),
    "mitsubishi.fusorosa": Body("bus", "midi_bus", (5.136, 1.27, 1.70), 2),
    "nissan.micra": Body("car", "hatchback", (1.817, 0.923, 0.751)),
    "nissan.patrol": Body("car", "suv", (2.302, 0.966, 0.927)),
    "nissan.patrol_2021": Body("car", "suv", (2.783, 1.075, 1.023), 2),
    "seat.leon": Body("car", "compact", (2.096, 0.908, 0.737)),
    "tesla.cybertruck": Body("car", "pickup", (3.137, 1.195, 1.049)),
    "tesla.model3": Body("car", "sedan", (2.396, 1.082, 0.744)),
    "toyota.prius": Body("car", "compact", (2.257, 1.003, 0.762)),
    "vespa.zx125": Body("motorcycle", "scooter", (0.902, 0.36, 0.81)),
    "volkswagen.t2": Body("van", "caddy", (2.240, 1.035, 1.019)),
    "volkswagen.t2_2021": Body("van", "caddy", (2.221, 0.887, 0.994), 2),
    "yamaha.yzf": Body("motorcycle", "roadster", (1.105, 0.434, 0.80)),
}
CHILDREN = frozenset({9, 10, 11, 12, 13, 14, 48, 49})  # numbers of walkers
WALKERS = 52
WALKER_SIZES: dict[str, tuple[float, float, float]] = {  # shape -> half extents [m]
    "tall": (0.188, 0.188, 0.93),
    "child": (0.188, 0.188, 0.65),
}
PROPS: dict[str, tuple[str, tuple[float, float, float]]] = {  # clutter of `world.map.parameters`, half extents [m]
    "streetbarrier": ("railing", (0.60, 0.18, 0.52)),
    "trafficcone01": ("bollard", (0.18, 0.18, 0.35)),
    "trafficcone02": ("bollard", (0.14, 0.14, 0.30)),
    "constructioncone": ("bollard", (0.17, 0.17, 0.30)),
    "trafficwarning": ("cabinet", (0.70, 0.60, 1.20)),
    "warningconstruction": ("cabinet", (0.40, 0.20, 0.60)),
    "warningaccident": ("cabinet", (0.40, 0.20, 0.60)),
    "bin": ("bin", (0.35, 0.30, 0.55)),
    "trashcan01": ("bin", (0.35, 0.35, 0.55)),
    "trashcan02": ("bin", (0.35, 0.35, 0.55)),
    "container": ("container", (2.10, 0.90, 0.80)),
    "bench01": ("planter", (0.80, 0.35, 0.40)),
    "bench02": ("planter", (0.80, 0.35, 0.40)),
    "plantpot01": ("planter", (0.50, 0.50, 0.50)),
    "plantpot02": ("planter", (0.50, 0.50, 0.50)),
    "kiosk_01": ("kiosk", (1.80, 0.90, 1.10)),
    "busstop": ("shelter", (2.00, 0.75, 1.15)),
    "vendingmachine": ("cabinet", (0.45, 0.40, 0.95)),
    "box01": ("cabinet", (0.25, 0.25, 0.25)),
    "box02": ("cabinet", (0.25, 0.25, 0.25)),
    "box03": ("cabinet", (0.30, 0.25, 0.20)),
    "barrel": ("bin", (0.30, 0.30, 0.45)),
    "chainbarrier": ("railing", (0.75, 0.05, 0.45)),
    "chainbarrierend": ("post", (0.05, 0.05, 0.45)),
    "ironplank": ("cabinet", (0.60, 0.40, 0.03)),
    "mailbox": ("cabinet", (0.25, 0.25, 0.60)),
    "advertisement": ("cabinet", (0.65, 0.15, 1.10)),
    "briefcase": ("cabinet", (0.22, 0.10, 0.20)),
    "travelcase": ("cabinet", (0.25, 0.18, 0.35)),
    "shoppingcart": ("bin", (0.45, 0.30, 0.50)),
    "creasedbox01": ("cabinet", (0.30, 0.25, 0.15)),
    "dirtdebris01": ("cabinet", (0.80, 0.60, 0.05)),
    "atm": ("cabinet", (0.35, 0.45, 1.05)),
    "barbeque": ("cabinet", (0.60, 0.35, 0.60)),
    "bench03": ("planter", (0.80, 0.35, 0.45)),
    "bike helmet": ("cabinet", (0.14, 0.11, 0.09)),
    "bikeparking": ("rack", (1.00, 0.30, 0.45)),
    "brokentile01": ("cabinet", (0.20, 0.20, 0.025)),
    "brokentile02": ("cabinet", (0.20, 0.20, 0.025)),
    "brokentile03": ("cabinet", (0.20, 0.20, 0.025)),
    "brokentile04": ("cabinet", (0.20, 0.20, 0.025)),
    "busstoplb": ("shelter", (2.00, 0.75, 1.15)),
    "calibrator": ("cabinet", (0.50, 0.05, 0.50)),
    "clothcontainer": ("container", (0.60, 0.60, 0.90)),
    "clothesline": ("railing", (1.50, 0.40, 0.90)),
    "colacan": ("bin", (0.04, 0.04, 0.07)),
    "creasedbox02": ("cabinet", (0.30, 0.25, 0.15)),
    "creasedbox03": ("cabinet", (0.30, 0.25, 0.15)),
    "dirtdebris02": ("cabinet", (0.80, 0.60, 0.05)),
    "dirtdebris03": ("cabinet", (0.80, 0.60, 0.05)),
    "doghouse": ("cabinet", (0.55, 0.45, 0.45)),
    "foodcart": ("kiosk", (1.20, 0.80, 1.10)),
    "fountain": ("planter", (2.50, 2.50, 0.90)),
    "garbage01": ("cabinet", (0.30, 0.30, 0.05)),
    "garbage02": ("cabinet", (0.30, 0.30, 0.05)),
    "garbage03": ("cabinet", (0.30, 0.30, 0.05)),
    "garbage04": ("cabinet", (0.30, 0.30, 0.05)),
    "garbage05": ("cabinet", (0.30, 0.30, 0.05)),
    "garbage06": ("cabinet", (0.30, 0.30, 0.05)),
    "gardenlamp": ("bollard", (0.10, 0.10, 0.40)),
    "glasscontainer": ("container", (0.75, 0.75, 0.80)),
    "gnome": ("bollard", (0.12, 0.12, 0.30)),
    "guitarcase": ("cabinet", (0.55, 0.20, 0.12)),
    "haybale": ("container", (0.60, 0.60, 0.60)),
    "haybalelb": ("container", (0.60, 0.60, 0.60)),
    "maptable": ("cabinet", (0.60, 0.30, 0.55)),
    "mobile": ("cabinet", (0.07, 0.035, 0.025)),
    "motorhelmet": ("cabinet", (0.15, 0.13, 0.13)),
    "omri-0": ("cabinet", (0.30, 0.30, 0.30)),
    "omri-1": ("cabinet", (0.30, 0.30, 0.30)),
    "pergola": ("shelter", (2.00, 1.50, 1.25)),
    "plantpot03": ("planter", (0.40, 0.40, 0.40)),
    "plantpot04": ("planter", (0.40, 0.40, 0.40)),
    "plantpot05": ("planter", (0.40, 0.40, 0.40)),
    "plantpot06": ("planter", (0.40, 0.40, 0.40)),
    "plantpot07": ("planter", (0.40, 0.40, 0.40)),
    "plantpot08": ("planter", (0.40, 0.40, 0.40)),
    "plasticbag": ("cabinet", (0.20, 0.15, 0.20)),
    "plasticchair": ("cabinet", (0.28, 0.28, 0.45)),
    "plastictable": ("cabinet", (0.60, 0.45, 0.37)),
    "platformgarbage01": ("container", (1.50, 1.00, 0.60)),
    "purse": ("cabinet", (0.15, 0.07, 0.12)),
    "shop01": ("kiosk", (1.80, 0.90, 1.25)),
    "shoppingbag": ("cabinet", (0.18, 0.10, 0.20)),
    "shoppingtrolley": ("cabinet", (0.20, 0.18, 0.50)),
    "slide": ("cabinet", (1.40, 0.30, 0.90)),
    "streetfountain": ("bollard", (0.25, 0.25, 0.50)),
    "streetsign": ("post", (0.10, 0.30, 1.20)),
    "streetsign01": ("post", (0.10, 0.30, 1.20)),
    "streetsign04": ("post", (0.10, 0.30, 1.20)),
    "swing": ("railing", (1.50, 0.80, 1.10)),
    "swingcouch": ("shelter", (0.90, 0.60, 0.90)),
    "table": ("cabinet", (0.90, 0.40, 0.40)),
    "trampoline": ("container", (1.70, 1.70, 0.40)),
    "trashbag": ("bin", (0.35, 0.35, 0.35)),
    "trashcan03": ("bin", (0.30, 0.30, 0.55)),
    "trashcan04": ("bin", (0.30, 0.30, 0.55)),
    "trashcan05": ("bin", (0.30, 0.30, 0.55)),
    "wateringcan": ("cabinet", (0.20, 0.10, 0.15)),
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
