"""Place of a map on the WGS 84 ellipsoid: inverse Mercator projections of an OpenDRIVE header, with its offset.

Transverse Mercator is Krüger's series in the third flattening n, to n^4 (C. F. F. Karney, "Transverse Mercator with an
accuracy of a few nanometers", J. Geodesy 85, 2011, eqs. 11, 15, 36).
"""

import math

import numpy as np
from numpy.typing import NDArray

from flcav.world.geodesy import ECCENTRICITY2, EQUATOR_M, FLATTENING, convert_from_geodetic
from flcav.world.map.parameters import GeoReference
from flcav.world.opendrive.document import UNMOVED, MapOffset
from flcav.world.opendrive.projection import Projection, read_projection

STEP_M = 100.0  # distance over which the axes of a map's grid are taken


def locate_origin(reference: str, x: float, y: float, offset: MapOffset = UNMOVED) -> GeoReference | None:
    """Return the position of a map around its point (x, y) [m], with its axes on the ground.

    `reference` is the text of <geoReference>, see `read_projection`; `offset` is added to the map's coordinates before
    they are those of the projection, along whose grid the axes lie then. None where the reference is not understood,
    and where the place is none on Earth.
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


def _round(axis: NDArray[np.float64]) -> tuple[float, float]:
    east, north, _ = (np.round(axis, 9) + 0.0).tolist()  # no -0.0
    return east, north


def _place(projection: Projection, offset: MapOffset, x: float, y: float) -> GeoReference:
    """Return the position of the map's point (x, y) [m]; raises `ValueError` where there is none."""
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
