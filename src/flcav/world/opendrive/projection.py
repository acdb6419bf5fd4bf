"""Map projection of an OpenDRIVE header, from its PROJ string or EPSG code (ASAM OpenDRIVE 1.8, 8.5).

Understood are transverse Mercator, UTM and Mercator on the ellipsoids of WGS 84 and GRS 80, which differ by 0.1 mm, and
the spherical Mercator projection of web maps. Of parameters given twice PROJ takes the first, and `k_0` before `k`.
"""

import math
import re
from dataclasses import dataclass
from typing import Literal

from flcav.world.geodesy import ECCENTRICITY2, EQUATOR_M, POLE_M

UTM_SCALE, UTM_FALSE_EASTING_M, UTM_FALSE_NORTHING_M = 0.9996, 500_000.0, 10_000_000.0
ZONES = 60
EPSG = re.compile(
    r"(?:\+?init=)?(?:urn:ogc:def:crs:)?epsg:(?:[\d.]*:)?(\d+)(?:\s+\+(?:no_defs|type=crs))*", re.IGNORECASE
)
MERCATOR = {3857: "webmerc", 900913: "webmerc", 3395: "merc"}  # EPSG code -> PROJ's name
UTM = {  # first EPSG code, first zone, last zone
    "WGS 84, north": (32601, 1, ZONES),
    "ETRS89": (25828, 28, 38),
    "NAD83": (26901, 1, 23),
}
UTM_SOUTH = 32700  # EPSG code of WGS 84 / UTM zone 0 S
NUMBERS = ("zone", "lat_0", "lon_0", "lat_ts", "k", "k_0", "x_0", "y_0", "a", "b", "R")
ELSEWHERE = ("no_defs", "type", "wktext", "over", "approx", "geoidgrids", "vunits", "south")  # of height, or no number
USUAL = {  # parameters with the values that leave a projection on WGS 84 in metres as it is, to a metre
    "datum": ("WGS84", "NAD83"),
    "ellps": ("WGS84", "GRS80"),
    "towgs84": ("0,0,0", "0,0,0,0,0,0,0"),
    "nadgrids": ("@null",),
    "units": ("m",),
    "to_meter": ("1",),
    "axis": ("enu",),
    "pm": ("greenwich", "0"),
}
CENTIMETRE = 0.01


@dataclass(frozen=True)
class Projection:
    """A map projection on the WGS 84 ellipsoid; spherical Mercator takes geodetic latitudes for those of a sphere."""

    kind: Literal["tmerc", "merc", "webmerc"]  # transverse, ellipsoidal or spherical Mercator
    latitude_deg: float = 0.0  # of the origin; of a Mercator projection it is on the equator
    longitude_deg: float = 0.0  # of the origin, on the central meridian
    scale: float = 1.0  # on the central meridian; of a Mercator projection on the equator
    easting_m: float = 0.0  # x of the origin
    northing_m: float = 0.0  # y of the origin


def read_projection(reference: str) -> Projection | None:
    """Return the projection of the text of <geoReference>; None for one that is not understood as a whole."""
    code = EPSG.fullmatch(reference)
    words = [word.lstrip("+").partition("=") for word in reference.split()]
    named = {name: value for name, _, value in reversed(words)}
    kind = named.pop("proj", "")
    try:
        return _from_code(int(code[1])) if code else _from_parameters(kind, named)
    except (ArithmeticError, ValueError, KeyError):
        return None


def _from_code(code: int) -> Projection | None:
    for first, low, high in UTM.values():
        if low <= (zone := code - first + low) <= high:
            return _utm(zone, south=False)
    if 1 <= code - UTM_SOUTH <= ZONES:
        return _utm(code - UTM_SOUTH, south=True)
    return Projection("merc" if MERCATOR[code] == "merc" else "webmerc")


def _utm(zone: int, *, south: bool) -> Projection | None:
    if not 1 <= zone <= ZONES:
        return None
    return Projection(
        "tmerc", 0.0, 6.0 * zone - 183.0, UTM_SCALE, UTM_FALSE_EASTING_M, UTM_FALSE_NORTHING_M if south else 0.0
    )


def _from_parameters(kind: str, named: dict[str, str]) -> Projection | None:
    """Return the projection that PROJ makes of these parameters; raises `ValueError` where one is no number."""
    numbers = {name: float(named.pop(name)) for name in NUMBERS if name in named}
    south = "south" in named
    if not all(value in USUAL.get(name, ()) for name, value in named.items() if name not in ELSEWHERE):
        return None
    axis = numbers.get("R", numbers.get("a", EQUATOR_M))
    other = numbers.get("R", numbers.get("b", axis if "R" in numbers else POLE_M))
    sphere = abs(other - EQUATOR_M) < CENTIMETRE
    if abs(axis - EQUATOR_M) >= CENTIMETRE or not (sphere or abs(other - POLE_M) < CENTIMETRE):
        return None
    longitude, easting, northing = (numbers.get(name, 0.0) for name in ("lon_0", "x_0", "y_0"))
    scale = numbers.get("k_0", numbers.get("k", 1.0))
    if kind == "webmerc":
        return Projection("webmerc", 0.0, longitude, 1.0, easting, northing)
    if kind == "merc":
        if "lat_ts" in numbers:  # the parallel whose lengths are true
            true = math.radians(numbers["lat_ts"])
            flat = 0.0 if sphere else ECCENTRICITY2
            scale = math.cos(true) / math.sqrt(1 - flat * math.sin(true) ** 2)
        return Projection("webmerc" if sphere else "merc", 0.0, longitude, scale, easting, northing)
    if sphere:
        return None
    if kind == "tmerc":
        return Projection("tmerc", numbers.get("lat_0", 0.0), longitude, scale, easting, northing)
    return _utm(int(numbers["zone"]), south=south) if kind == "utm" else None
