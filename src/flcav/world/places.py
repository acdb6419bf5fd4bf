"""Places in users' tables, given as x, y, z in a town, as x, y on its ground, or as latitude and longitude."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import pyarrow as pa

from flcav.arrays import Array
from flcav.config import InputError, shorten
from flcav.interface.wording import plural
from flcav.storage.tables import numbers, read_input_table
from flcav.world.geodesy import find_on_ground
from flcav.world.map.town import Town

AXES = ("x", "y", "z")
LATITUDE, LONGITUDE = "latitude", "longitude"
NAMES = ("id", "name")  # columns whose spelling is kept
SPELLINGS = {  # words in the name of a column, by its meaning
    LATITUDE: ("latitude", "latitud", "lat", "breite", "breitengrad", "ygcswgs"),
    LONGITUDE: (
        "longitude",
        "longitud",
        "lon",
        "lng",
        "long",
        "länge",
        "laenge",
        "längengrad",
        "laengengrad",
        "xgcswgs",
    ),
}
UNITS = ("m", "deg", "degree", "degrees", "metre", "metres", "meter", "meters")
WORD = re.compile(r"[A-ZÄÖÜ]+(?![a-zäöüß])|[A-ZÄÖÜ]?[a-zäöüß]+")
ALIKE = 0.75  # least similarity of a misspelt column to a known one


@dataclass(frozen=True)
class Places:
    """A table of N places with the known names of its columns, and the positions of the places."""

    table: pa.Table
    xyz: Array  # (N, 3) world [m]
    degrees: Array | None  # (N, 2) latitude and longitude; None: the table has x and y
    note: str  # a sentence on assumptions and unused columns; "" for a table as flcav writes it


def read_places(path: Path, what: str, known: Sequence[str], town: Town | None, height_m: float = 0.0) -> Places:
    """Return the places in a CSV or Parquet table; without a height, they are `height_m` [m] above the town's ground.

    Column names may have capitals and units. A table with x, y and z, as flcav writes it, has only `known` columns;
    in other tables further columns are ignored. `what` is the noun for a row.

    Raises `InputError` for files that are no such tables, columns that are missing, repeated or misspelt, places that
    are no numbers or not on Earth, and latitudes without a town.
    """
    named = [spelling for name in NAMES for spelling in (name, name.upper(), name.capitalize())]
    table = _rename(read_input_table(path, (), named), path, known)
    geodetic = LATITUDE in table.column_names and LONGITUDE in table.column_names
    axes = (LATITUDE, LONGITUDE) if geodetic else AXES[:2]
    for axis in axes:
        if axis not in table.column_names:
            lone = next(
                (LATITUDE if name == LONGITUDE else LONGITUDE for name in SPELLINGS if name in table.column_names), axis
            )
            raise InputError(
                f"{path}: column '{lone}' is missing; places are x, y [m] in the town, or latitude, longitude; found "
                f"{', '.join(table.column_names)}"
            )
    if geodetic and town is None:
        raise InputError(f"{path}: has latitude and longitude; give --town, whose geo-reference says where they are")
    foreign = geodetic or "z" not in table.column_names
    flat = numbers(table, axes, path)
    used = (*axes, *(name for name in known if not (geodetic and name in AXES)))
    left_out = [name for name in table.column_names if name not in used]
    for name in left_out:
        close = get_close_matches(name.lower(), known, 1, ALIKE)
        if close and name not in known:
            raise InputError(
                f"{path}: unknown column '{name}' (did you mean '{close[0]}'?); known are {', '.join(known)}"
            )
        if not foreign:
            raise InputError(f"{path}: unknown column '{name}'; known are {', '.join(known)}")
    if not foreign and "height_m" in table.column_names:
        raise InputError(f"{path}: columns 'z' and 'height_m' both say how high places are; give one of them")
    heights = numbers(table, ("height_m",), path)[:, 0] if "height_m" in table.column_names else height_m
    if geodetic and town is not None:
        odd = np.flatnonzero((np.abs(flat) > (90, 180)).any(axis=1))
        if len(odd):
            latitude, longitude = flat[odd[0]]
            place = f"latitude {latitude:g}, longitude {longitude:g}"
            raise InputError(f"{path}: row {odd[0] + 1}: {place} is no place on Earth")
        xyz = find_on_ground(town, *flat.T) + np.outer(np.broadcast_to(heights, len(flat)), (0, 0, 1))
    elif foreign:
        ground = np.zeros(len(flat)) if town is None else town.grounds(*flat.T)
        xyz = np.column_stack((flat, ground + heights))
    else:
        xyz = numbers(table, AXES, path)
    if not foreign:
        return Places(table, xyz, None, "")
    where = "level ground" if town is None else f"the ground of {town.name}"
    above = "on" if not np.any(heights) else "above" if "height_m" in table.column_names else f"{height_m:g} m above"
    by = "latitude and longitude" if geodetic else "x and y"
    unused = f"; not used: {', '.join(map(_shown, left_out))}" if left_out else ""
    return Places(
        table, xyz, flat if geodetic else None, f"{path}: {plural(len(xyz), what)} by {by}, {above} {where}{unused}"
    )


def _shown(name: str) -> str:
    return name if name.isprintable() and len(name) <= 40 else shorten(name)


def _rename(table: pa.Table, path: Path, known: Sequence[str]) -> pa.Table:
    """Return the table with its columns renamed to their known names."""
    meant: dict[str, str] = {}
    for name in table.column_names:
        words = [word.lower() for word in WORD.findall(name)]
        plain = "_".join(word for word in words if word not in UNITS)
        places = [what for what, spelt in SPELLINGS.items() if any(word in spelt for word in words)]
        what = next((one for one in known if one in (name, name.strip().lower(), plain, f"{plain}_m")), None)
        what = what or (places[0] if len(places) == 1 else name)
        if what in meant:
            raise InputError(
                f"{path}: columns '{meant[what]}' and '{name}' could both be the {what}; rename one of them"
            )
        meant[what] = name
    return table.rename_columns(list(meant))
