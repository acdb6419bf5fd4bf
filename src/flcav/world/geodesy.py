"""Geodetic positions on the WGS 84 ellipsoid.

Points of a town (east, north, up from its origin) are converted to latitude, longitude and altitude by way of
Earth-centred, Earth-fixed (ECEF) coordinates, without approximation; ECEF to latitude by Bowring's iteration ("The
accuracy of geodetic latitude and height equations", Survey Review 28:202, 1985), exact to nanometres near the ground.
"""

import numpy as np
from numpy.typing import ArrayLike

from flcav.arrays import Array
from flcav.world.map.parameters import GeoReference
from flcav.world.map.town import Town

EQUATOR_M = 6_378_137.0  # semi-major axis of the WGS 84 ellipsoid
FLATTENING = 1 / 298.257223563
POLE_M = EQUATOR_M * (1 - FLATTENING)  # semi-minor axis
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)  # first eccentricity, squared
ITERATIONS = 4  # of Bowring's method


def convert_to_geodetic(origin: GeoReference, enu: Array) -> Array:
    """Convert points (..., 3) x, y, up [m] to (..., 3) latitude [deg], longitude [deg], altitude [m], WGS 84.

    x and y are east and north of `origin`, unless it has other axes.
    """
    return _from_earth(_to_earth(origin) + enu @ (_earth_from_enu(origin) @ _enu_from_map(origin)).T)


def convert_from_geodetic(origin: GeoReference, place: GeoReference) -> Array:
    """Return (3,) east, north, up [m] of `place` relative to `origin`, independent of their maps' axes."""
    return (_to_earth(place) - _to_earth(origin)) @ _earth_from_enu(origin)


def convert_to_map(origin: GeoReference, geodetic: Array) -> Array:
    """Convert latitude, longitude [deg], altitude [m] (..., 3) to x, y, up [m], as the inverse of the above."""
    enu = (_place_on_earth(*np.moveaxis(geodetic, -1, 0)) - _to_earth(origin)) @ _earth_from_enu(origin)
    return enu @ np.linalg.inv(_enu_from_map(origin)).T


def find_on_ground(town: Town, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> Array:
    """Return the places (..., 3) x, y, z [m, world] on the ground of a town at latitudes and longitudes [deg, WGS 84].

    >>> from flcav import load_town
    >>> find_on_ground(load_town("suburb"), 49.0, [8.4, 8.401]).round(1).tolist()
    [[0.0, 0.0, 0.0], [73.2, 0.0, 0.0]]
    """
    latitude, longitude = np.broadcast_arrays(
        np.asarray(latitude_deg, np.float64), np.asarray(longitude_deg, np.float64)
    )
    geodetic = np.stack((latitude, longitude, np.full(latitude.shape, town.geo.altitude_m)), axis=-1)
    x, y, _ = np.moveaxis(convert_to_map(town.geo, geodetic), -1, 0)
    return np.stack((x, y, town.grounds(x, y)), axis=-1)


def _to_earth(at: GeoReference) -> Array:
    return _place_on_earth(*np.array((at.latitude_deg, at.longitude_deg, at.altitude_m)))


def _place_on_earth(latitude_deg: Array, longitude_deg: Array, altitude_m: Array) -> Array:
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    normal = EQUATOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(lat) ** 2)
    level = (normal + altitude_m) * np.cos(lat)
    up = (normal * (1 - ECCENTRICITY2) + altitude_m) * np.sin(lat)
    return np.stack((level * np.cos(lon), level * np.sin(lon), up), axis=-1)


def _earth_from_enu(at: GeoReference) -> Array:
    lat, lon = np.radians((at.latitude_deg, at.longitude_deg))
    east = (-np.sin(lon), np.cos(lon), 0.0)
    north = (-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat))
    up = (np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat))
    return np.array((east, north, up)).T


def _enu_from_map(at: GeoReference) -> Array:
    return np.array(((*at.x_axis, 0.0), (*at.y_axis, 0.0), (0.0, 0.0, 1.0))).T


def _from_earth(earth: Array) -> Array:
    x, y, z = np.moveaxis(earth, -1, 0)
    level = np.hypot(x, y)
    beyond = ECCENTRICITY2 / (1 - ECCENTRICITY2)
    reduced = np.arctan2(z * EQUATOR_M, level * POLE_M)
    lat = reduced
    for _ in range(ITERATIONS):
        lat = np.arctan2(
            z + beyond * POLE_M * np.sin(reduced) ** 3, level - ECCENTRICITY2 * EQUATOR_M * np.cos(reduced) ** 3
        )
        reduced = np.arctan2((1 - FLATTENING) * np.sin(lat), np.cos(lat))
    altitude = level * np.cos(lat) + z * np.sin(lat) - EQUATOR_M * np.sqrt(1 - ECCENTRICITY2 * np.sin(lat) ** 2)
    return np.stack((np.degrees(lat), np.degrees(np.arctan2(y, x)), altitude), axis=-1)
