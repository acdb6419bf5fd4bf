"""Materials of surfaces: reflectivity at 905 nm for LiDAR, and appearance in visible light for cameras."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

PAINT_REFLECTIVITY = np.array([0.08, 0.14, 0.22, 0.30, 0.45, 0.60, 0.70], np.float32)  # (P,) car paints, black to white
# Albedos, linear red, green, blue, by entry of PAINT_REFLECTIVITY: dark at 905 nm is roughly dark in visible light.
PAINT_COLOURS: tuple[tuple[tuple[float, float, float], ...], ...] = (
    ((0.010, 0.010, 0.012), (0.012, 0.014, 0.022), (0.020, 0.012, 0.012)),
    ((0.045, 0.047, 0.052), (0.012, 0.030, 0.110), (0.015, 0.055, 0.040)),
    ((0.100, 0.104, 0.110), (0.020, 0.075, 0.240), (0.160, 0.012, 0.016)),
    ((0.180, 0.185, 0.190), (0.420, 0.022, 0.020), (0.060, 0.160, 0.300)),
    ((0.330, 0.335, 0.340), (0.560, 0.060, 0.025), (0.310, 0.270, 0.200)),
    ((0.520, 0.525, 0.530), (0.700, 0.420, 0.030), (0.450, 0.520, 0.560)),
    ((0.780, 0.780, 0.770), (0.700, 0.690, 0.640)),
)
CLOTH_COLOURS = (  # albedos, linear red, green, blue
    (0.030, 0.032, 0.040),
    (0.18, 0.18, 0.19),
    (0.55, 0.54, 0.50),
    (0.020, 0.045, 0.150),
    (0.30, 0.030, 0.028),
    (0.045, 0.12, 0.060),
    (0.42, 0.30, 0.090),
    (0.12, 0.070, 0.040),
    (0.10, 0.20, 0.30),
    (0.62, 0.35, 0.02),
)
TROUSER_COLOURS = (  # albedos, linear red, green, blue
    (0.016, 0.017, 0.022),
    (0.030, 0.048, 0.105),
    (0.055, 0.085, 0.16),
    (0.16, 0.13, 0.09),
    (0.09, 0.09, 0.09),
)
SKIN_TONES = (1.0, 1.15, 0.75, 0.45, 0.25)  # factors of the albedo of SKIN


class Material(IntEnum):
    """The material of a face."""

    GROUND = 0
    ROAD = 1
    SIDEWALK = 2
    WALL = 3
    ROOF = 4
    BARK = 5
    LEAF = 6
    METAL = 7
    SIGN = 8
    PAINT = 9
    GLASS = 10
    TYRE = 11
    RIM = 12
    HEADLAMP = 13
    TAILLAMP = 14
    PLATE = 15
    TRIM = 16
    INTERIOR = 17
    SKIN = 18
    CLOTH = 19
    TROUSERS = 20
    LAMP = 21  # the luminous side of a street lamp
    LENS_RED = 22  # of a signal head
    LENS_AMBER = 23
    LENS_GREEN = 24


class Optics(NamedTuple):
    """Reflection of a 905 nm laser pulse by a material."""

    reflectivity: float  # diffuse reflectance, 0 to 1
    retro: bool = False  # retroreflector: reflects towards the source at any angle of incidence


OPTICS: dict[Material, Optics] = {
    Material.GROUND: Optics(0.30),
    Material.ROAD: Optics(0.17),
    Material.SIDEWALK: Optics(0.28),
    Material.WALL: Optics(0.42),
    Material.ROOF: Optics(0.35),
    Material.BARK: Optics(0.25),
    Material.LEAF: Optics(0.45),
    Material.METAL: Optics(0.40),
    Material.SIGN: Optics(0.95, retro=True),
    Material.PAINT: Optics(0.30),  # replaced per actor by one of PAINT_REFLECTIVITY
    Material.GLASS: Optics(0.03),
    Material.TYRE: Optics(0.05),
    Material.RIM: Optics(0.45),
    Material.HEADLAMP: Optics(0.60, retro=True),
    Material.TAILLAMP: Optics(0.80, retro=True),
    Material.PLATE: Optics(0.95, retro=True),
    Material.TRIM: Optics(0.07),
    Material.INTERIOR: Optics(0.22),
    Material.SKIN: Optics(0.45),
    Material.CLOTH: Optics(0.38),
    Material.TROUSERS: Optics(0.22),
    Material.LAMP: Optics(0.40),
    Material.LENS_RED: Optics(0.12),
    Material.LENS_AMBER: Optics(0.20),
    Material.LENS_GREEN: Optics(0.12),
}

# Columns of OPTICS, by material.
REFLECTIVITY = np.array([OPTICS[material].reflectivity for material in Material], np.float32)
RETRO = np.array([OPTICS[material].retro for material in Material], np.bool_)


class Look(NamedTuple):
    """Appearance of a material in visible light: diffuse albedo, specular reflectance and gloss."""

    colour: tuple[float, float, float]  # diffuse albedo, linear red, green, blue
    mirror: float = 0.0  # specular reflectance at normal incidence (Schlick at others)
    gloss: float = 0.0  # exponent of the specular highlight; 0 for none


LOOKS: dict[Material, Look] = {
    Material.GROUND: Look((0.062, 0.094, 0.034)),
    Material.ROAD: Look((0.072, 0.072, 0.076)),
    Material.SIDEWALK: Look((0.27, 0.26, 0.245)),
    Material.WALL: Look((0.42, 0.37, 0.31)),
    Material.ROOF: Look((0.23, 0.20, 0.18)),
    Material.BARK: Look((0.10, 0.075, 0.05)),
    Material.LEAF: Look((0.060, 0.115, 0.022)),
    Material.METAL: Look((0.20, 0.21, 0.22), mirror=0.10, gloss=30.0),
    Material.SIGN: Look((0.80, 0.80, 0.80), mirror=0.02),
    Material.PAINT: Look((0.30, 0.30, 0.30), mirror=0.045, gloss=400.0),
    Material.GLASS: Look((0.016, 0.019, 0.019), mirror=0.11, gloss=900.0),
    Material.TYRE: Look((0.018, 0.018, 0.019)),
    Material.RIM: Look((0.19, 0.195, 0.20), mirror=0.18, gloss=60.0),
    Material.HEADLAMP: Look((0.50, 0.52, 0.55), mirror=0.20, gloss=300.0),
    Material.TAILLAMP: Look((0.35, 0.012, 0.010), mirror=0.06, gloss=300.0),
    Material.PLATE: Look((0.72, 0.72, 0.68), mirror=0.03),
    Material.TRIM: Look((0.022, 0.022, 0.024), mirror=0.03, gloss=20.0),
    Material.INTERIOR: Look((0.055, 0.050, 0.045)),
    Material.SKIN: Look((0.46, 0.27, 0.18)),
    Material.CLOTH: Look((0.25, 0.25, 0.28)),
    Material.TROUSERS: Look((0.055, 0.065, 0.11)),
    Material.LAMP: Look((0.55, 0.55, 0.50), mirror=0.04),
    Material.LENS_RED: Look((0.085, 0.010, 0.008), mirror=0.05, gloss=80.0),
    Material.LENS_AMBER: Look((0.085, 0.045, 0.006), mirror=0.05, gloss=80.0),
    Material.LENS_GREEN: Look((0.008, 0.070, 0.038), mirror=0.05, gloss=80.0),
}

# Columns of LOOKS, by material.
COLOUR = np.array([LOOKS[material].colour for material in Material], np.float32)
MIRROR = np.array([LOOKS[material].mirror for material in Material], np.float32)
GLOSS = np.array([LOOKS[material].gloss for material in Material], np.float32)
