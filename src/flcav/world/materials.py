"""What surfaces are made of, and how much of a 905 nm pulse they send back."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np


class Material(IntEnum):
    """Material of one face."""

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


class Optics(NamedTuple):
    """How a material answers a pulse."""

    reflectivity: float  # share of the light sent back, diffusely
    retro: bool = False  # sends light back where it came from, whatever the incidence


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
    Material.PAINT: Optics(0.30),  # each actor has its own, of PAINT_REFLECTIVITY
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
}

REFLECTIVITY = np.array([OPTICS[material].reflectivity for material in Material], np.float32)
RETRO = np.array([OPTICS[material].retro for material in Material], np.bool_)
PAINT_REFLECTIVITY = np.array([0.08, 0.14, 0.22, 0.30, 0.45, 0.60, 0.70], np.float32)  # black ... white
