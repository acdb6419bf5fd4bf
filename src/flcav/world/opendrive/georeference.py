"""Place of a map on the WGS 84 ellipsoid: the map projection of an OpenDRIVE header, its offset, and their inverse.

The projection is read from a PROJ string or an EPSG code (ASAM OpenDRIVE 1.8, 8.5). Supported are transverse Mercator,
UTM and Mercator on the ellipsoids of WGS 84 and GRS 80, which differ by 0.1 mm, and the spherical Mercator projection
of web maps. Of a repeated parameter the first counts, and `k_0` before `k`, as in PROJ.

Transverse Mercator is Krüger's series in the third flattening n, to n^4 (C. F. F. Karney, "Transverse Mercator with an
accuracy of a few nanometers", J. Geodesy 85, 2011, eqs. 11, 15, 36).
"""

import math
import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flcav.arrays import Array
from flcav.world.geodesy import ECCENTRICITY2, EQUATOR_M, FLATTENING, POLE_M, convert_from_geodetic
from flcav.world.map.parameters import GeoReference
from flcav.world.opendrive.document import UNMOVED, MapOffset

UTM_SCALE, UTM_FALSE_EASTING_M, UTM_FALSE_NORTHING_M = 0.9996, 500_000.0, 10_000_000.0
ZONES = 60
EPSG = re.compile(
    r"(?:\+?init=)?(?:urn:ogc:def:crs:)?epsg:(?:[\d.]*:)?(\d+)(?:\s+\+(?:no_defs|type=crs))*", re.IGNORECASE
)
MERCATOR = {3857: "webmerc", 900913: "webmerc", 3395: "merc"}  # EPSG code -> PROJ's name
UTM = {  # series of EPSG codes -> first code, first zone, last zone
    "WGS 84, north": (32601, 1, ZONES),
    "ETRS89": (25828, 28, 38),
    "NAD83": (26901, 1, 23),
}
UTM_SOUTH = 32700  # EPSG code of WGS 84 / UTM zone 0 S
NUMBERS = ("zone", "lat_0", "lon_0", "lat_ts", "k", "k_0", "x_0", "y_0", "a", "b", "R")
ELSEWHERE = ("no_defs", "type", "wktext", "over", "approx", "geoidgrids", "vunits", "south")  # of height, or no number
USUAL = {  # parameter -> values that change a projection on WGS 84 in metres by less than a metre
    "datum": ("WGS84", "NAD83"),
    "ellps": ("WGS84", "GRS80"),
    "towgs84": ("0,0,0", "0,0,0,0,0,0,0"),
    "nadgrids": ("@null",),
    "units": ("m",),
    "to_meter": ("1",),
    "axis": ("enu",),
    "pm": ("greenwich", "0"),
}
CENTIMETRE = 0.01  # largest difference of equal axes [m]


@dataclass(frozen=True)
class Projection:
    """A map projection of the WGS 84 ellipsoid; spherical Mercator takes geodetic latitudes as those of a sphere."""

    kind: Literal["tmerc", "merc", "webmerc"]  # transverse, ellipsoidal or spherical Mercator
    latitude_deg: float = 0.0  # latitude of the origin; 0 in a Mercator projection
    longitude_deg: float = 0.0  # longitude of the origin and of the central meridian
    scale: float = 1.0  # scale factor on the central meridian; in a Mercator projection on the equator
    easting_m: float = 0.0  # x of the origin
    northing_m: float = 0.0  # y of the origin


def read_projection(reference: str) -> Projection | None:
    """Parse the text of <geoReference>; None where any part of it is not understood."""
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
    """Build the projection that PROJ makes of its parameters; None if unsupported.

    `kind` is the value of +proj, `named` holds the other parameters. Raises `ValueError` where one is no number.
    """
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


STEP_M = 100.0  # distance to both sides over which the directions of the map's axes are measured


def locate_origin(reference: str, x: float, y: float, offset: MapOffset = UNMOVED) -> GeoReference | None:
    """Locate the point (x, y) [m] of a map on Earth, with the directions of the map's axes on the ground there.

    `reference` is the text of <geoReference>, see `read_projection`; `offset` transforms the map's frame to the plane
    of the projection. None where the reference is not understood, or where the point has no place on Earth.
    """
    projection = read_projection(reference)
    if projection is None:
        return None
    try:
        here = _place(projection, offset, x, y)
        x_axis, y_axis = (
            convert_from_geodetic(here, _place(projection, offset, x + dx, y + dy))
            - convert_from_geodetic(here, _place(projection, offset, x - dx, y - dy))
            for dx, dy in ((STEP_M, 0.0), (0.0, STEP_M))
        )
        return GeoReference(
            latitude_deg=round(here.latitude_deg, 9),
            longitude_deg=round(here.longitude_deg, 9),
            altitude_m=offset.z,
            x_axis=_round(x_axis / (2 * STEP_M)),
            y_axis=_round(y_axis / (2 * STEP_M)),
        )
    except (ArithmeticError, ValueError):  # no number, or one out of range
        return None


def _round(axis: Array) -> tuple[float, float]:
    east, north, _ = (np.round(axis, 9) + 0.0).tolist()  # no -0.0
    return east, north


def _place(projection: Projection, offset: MapOffset, x: float, y: float) -> GeoReference:
    """Locate the map's point (x, y) [m] on Earth; raises `ValueError` where it has no place there."""
    x, y = offset.apply(x, y)
    east, north = x - projection.easting_m, y - projection.northing_m
    if projection.kind == "tmerc":
        latitude, longitude = inverse_mercator(
            east, north, projection.latitude_deg, projection.longitude_deg, projection.scale
        )
    else:
        radius = projection.scale * EQUATOR_M
        tangent = math.sinh(north / radius)
        latitude = math.degrees(math.atan(tangent if projection.kind == "webmerc" else _geodetic_tangent(tangent)))
        longitude = projection.longitude_deg + math.degrees(east / radius)
    if not abs(longitude) <= 360:
        raise ValueError(f"no such longitude: {longitude}")
    wrapped = (longitude + 180.0) % 360.0 - 180.0
    return GeoReference(latitude_deg=latitude, longitude_deg=wrapped, altitude_m=offset.z)


def inverse_mercator(
    east_m: float, north_m: float, latitude_0: float, longitude_0: float, scale: float
) -> tuple[float, float]:
    """Invert the transverse Mercator projection (Karney, section 3); return latitude and longitude [deg].

    `east_m` and `north_m` [m] are counted from the projection's origin at `latitude_0`, `longitude_0` [deg]; `scale` is
    the scale factor on the central meridian.
    """
    n = FLATTENING / (2 - FLATTENING)
    radius = EQUATOR_M / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180,
        13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140,
        49561 * n**4 / 161280,
    )
    beta = (
        n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96 - n**4 / 360,
        n**2 / 48 + n**3 / 15 - 437 * n**4 / 1440,
        17 * n**3 / 480 - 37 * n**4 / 840,
        4397 * n**4 / 161280,
    )
    conformal = math.atan(_conformal_tangent(math.tan(math.radians(latitude_0))))
    origin = conformal + sum(a * math.sin(2 * (j + 1) * conformal) for j, a in enumerate(alpha))
    xi, eta = north_m / (scale * radius) + origin, east_m / (scale * radius)
    orders = [2 * (j + 1) for j in range(4)]
    xi_0 = xi - sum(b * math.sin(k * xi) * math.cosh(k * eta) for b, k in zip(beta, orders))
    eta_0 = eta - sum(b * math.cos(k * xi) * math.sinh(k * eta) for b, k in zip(beta, orders))
    tangent = math.sin(xi_0) / math.hypot(math.sinh(eta_0), math.cos(xi_0))
    longitude = math.atan2(math.sinh(eta_0), math.cos(xi_0))
    return math.degrees(math.atan(_geodetic_tangent(tangent))), longitude_0 + math.degrees(longitude)


def _conformal_tangent(tangent: float) -> float:
    """Convert the tangent of a geodetic latitude to that of the conformal latitude (eqs. 7-9)."""
    e = math.sqrt(ECCENTRICITY2)
    sigma = math.sinh(e * math.atanh(e * tangent / math.hypot(1, tangent)))
    return tangent * math.hypot(1, sigma) - sigma * math.hypot(1, tangent)


def _geodetic_tangent(conformal: float) -> float:
    """Convert the tangent of a conformal latitude to that of the geodetic latitude, by Newton's method (eqs. 19-21)."""
    e2 = ECCENTRICITY2
    tangent = conformal / (1 - e2)
    for _ in range(6):
        guess = _conformal_tangent(tangent)
        slope = (1 - e2) * math.hypot(1, guess) * math.hypot(1, tangent) / (1 + (1 - e2) * tangent**2)
        tangent += (conformal - guess) / slope
    return tangent
