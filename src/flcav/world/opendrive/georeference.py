"""Inverse transverse Mercator and UTM projection on WGS 84, from the PROJ string of an OpenDRIVE header.

Krüger's series in the third flattening n, to n^4 (C. F. F. Karney, "Transverse Mercator with an accuracy of a few
nanometers", J. Geodesy 85, 2011, eqs. 11, 15, 36).
"""

import math

from flcav.world.geodesy import ECCENTRICITY2, EQUATOR_M, FLATTENING
from flcav.world.map.parameters import GeoReference

UTM_SCALE, UTM_FALSE_EASTING_M, UTM_FALSE_NORTHING_M = 0.9996, 500_000.0, 10_000_000.0


def locate_origin(projection: str, x: float, y: float) -> GeoReference | None:
    """Return the geodetic position of the point (x, y) [m] in a map with the PROJ string `projection`.

    None for a projection other than +proj=tmerc and +proj=utm, and for values that are no numbers or out of range. The
    town keeps the axes of the projection's grid: y is grid north. The altitude is 0.
    """
    parts = (word.lstrip("+").partition("=") for word in projection.split())
    words = {name: value for name, _, value in parts}
    try:
        if words.get("proj") == "utm":
            north = 0.0 if "south" not in words else UTM_FALSE_NORTHING_M
            meridian = 6.0 * int(words["zone"]) - 183.0
            latitude, longitude = inverse_mercator(x - UTM_FALSE_EASTING_M, y - north, 0.0, meridian, UTM_SCALE)
        elif words.get("proj") == "tmerc":
            east, north = x - float(words.get("x_0", 0)), y - float(words.get("y_0", 0))
            scale = float(words.get("k", words.get("k_0", 1)))
            start, meridian = float(words.get("lat_0", 0)), float(words.get("lon_0", 0))
            latitude, longitude = inverse_mercator(east, north, start, meridian, scale)
        else:
            return None
    except (ValueError, KeyError):
        return None
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        return None
    wrapped = (longitude + 180.0) % 360.0 - 180.0
    return GeoReference(latitude_deg=round(latitude, 9), longitude_deg=round(wrapped, 9), altitude_m=0.0)


def inverse_mercator(
    east_m: float, north_m: float, latitude_0: float, longitude_0: float, scale: float
) -> tuple[float, float]:
    """Return latitude and longitude [deg] of a point east and north of the projection's origin (Karney, section 3).

    `latitude_0` and `longitude_0` are the origin [deg], `scale` is the scale factor on the central meridian.
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
    """Return the tangent of the conformal latitude, given that of the geodetic one (eqs. 7-9)."""
    e = math.sqrt(ECCENTRICITY2)
    sigma = math.sinh(e * math.atanh(e * tangent / math.hypot(1, tangent)))
    return tangent * math.hypot(1, sigma) - sigma * math.hypot(1, tangent)


def _geodetic_tangent(conformal: float) -> float:
    """Return the tangent of the geodetic latitude, given that of the conformal one, by Newton's method (eqs. 19-21)."""
    e2 = ECCENTRICITY2
    tangent = conformal / (1 - e2)
    for _ in range(6):
        guess = _conformal_tangent(tangent)
        slope = (1 - e2) * math.hypot(1, guess) * math.hypot(1, tangent) / (1 + (1 - e2) * tangent**2)
        tangent += (conformal - guess) / slope
    return tangent
