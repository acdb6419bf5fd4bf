"""How much of a 77 GHz wave things send back: radar cross-sections of actors by class and aspect, and of the town.

Means of actors are those commonly measured at 76 to 81 GHz (pedestrian -8 dBsm: Yamada et al., 2005; cars 10 dBsm with
flashes off flat front, rear and sides: Schipper et al., 2011). What an actor sends back is spread evenly over its
silhouette, so that a half hidden car answers half as loud. Ground follows the constant-gamma model of land clutter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.world.materials import Material
from flcav.world.trace import CATEGORIES

Array = NDArray[np.float64]


class Echo(NamedTuple):
    """How a class of actor answers."""

    mean_dbsm: float
    flash_db: float  # above the mean, from straight ahead, behind and either side
    end_db: float  # above the sides, from ahead and behind


ECHOES: dict[str, Echo] = {
    "car": Echo(8.0, 9.0, -3.0),
    "van": Echo(11.0, 10.0, -3.0),
    "truck": Echo(16.0, 12.0, -4.0),
    "bus": Echo(17.0, 13.0, -5.0),
    "motorcycle": Echo(2.0, 4.0, -3.0),
    "bicycle": Echo(-3.0, 4.0, -4.0),
    "pedestrian": Echo(-8.0, 1.0, 1.5),
}
FLASH = 24.0  # exponent of the cosine: a flash is about 25 degrees wide at half power

LYING = (Material.GROUND, Material.ROAD, Material.SIDEWALK)
TOWN_DB: dict[Material, float] = {
    Material.GROUND: -20.0,  # of the lying: gamma
    Material.ROAD: -30.0,
    Material.SIDEWALK: -28.0,
    Material.WALL: -10.0,  # of the others: per square metre of their silhouette, from the side
    Material.ROOF: -10.0,
    Material.BARK: -8.0,
    Material.LEAF: -14.0,
    Material.METAL: 2.0,
    Material.SIGN: 4.0,
}
ELSE_DB = -5.0
GLINT_DB = 20.0  # by which a flat face is brighter face on
GLINT = 40.0

_TOWN = 10 ** (np.array([TOWN_DB.get(material, ELSE_DB) for material in Material]) / 10)
_LIES = np.array([material in LYING for material in Material])
_ACTOR = np.array([ECHOES[category] for category in CATEGORIES])


def actor_rcs(category: NDArray[np.str_], aspect: Array) -> Array:
    """Return (K,) radar cross-sections [m^2] of whole actors, seen from `aspect` [rad] counter-clockwise of ahead."""
    mean, flash, end = _ACTOR[[CATEGORIES.index(str(name)) for name in category]].reshape(-1, 3).T
    ahead, aside = np.abs(np.cos(aspect)) ** FLASH, np.abs(np.sin(aspect)) ** FLASH
    return 10 ** ((mean + flash * (ahead + aside) + end * np.cos(aspect) ** 2) / 10)


def silhouette(size: Array, aspect: Array) -> Array:
    """Return (K,) areas [m^2] of boxes of `size` (K, 3) seen level from `aspect` [rad]."""
    length, width, height = size.T
    return (length * np.abs(np.sin(aspect)) + width * np.abs(np.cos(aspect))) * height


def town_rcs_per_area(material: NDArray[np.uint8], cosine: Array) -> Array:
    """Return (K,) m^2 per square metre of silhouette of the town's surfaces, met at an incidence of that `cosine`."""
    glint = 1 + (10 ** (GLINT_DB / 10) - 1) * cosine**GLINT
    return _TOWN[material] * np.where(_LIES[material], 1.0, glint)
