"""Signs and poles of an OpenDRIVE map, where it says what and where they are (OpenDRIVE 1.8, 13 and 14)."""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import dataclass
from typing import Literal

from flcav.config import shorten
from flcav.world.map.parameters import PostParameters, SignParameters
from flcav.world.map.street_furniture import SIGN_HEIGHT_M, SPEED_SIGNS
from flcav.world.opendrive.objects import crosswalks, stop_lines
from flcav.world.opendrive.objects.places import locate, read_number, repeat_object
from flcav.world.opendrive.road_surface import Road

SIGNS: dict[str, Literal["stop", "yield"]] = {"206": "stop", "205": "yield"}  # numbers of the German catalogue
LIMIT_SIGN = "274"
KMH = {"km/h": 1.0, "mph": 1.609344, "m/s": 3.6}
PLATE_M = (1.2, 4.5)  # heights at which a plate is believed to hang
POST_M = (0.3, 15.0)  # heights of poles that are taken over
PAINTED = (crosswalks.MARKING, stop_lines.MARKING)  # types of signals that are paint


@dataclass(frozen=True)
class Signs:
    """The signs that a map describes, and how many were left out, by the reason."""

    found: tuple[SignParameters, ...]
    left: Counter[str]


@dataclass(frozen=True)
class Posts:
    """The poles that a map describes, each repetition one, and how many were left out, by the reason."""

    found: tuple[PostParameters, ...]
    left: Counter[str]


def find_signs(root: ElementTree.Element, offset_m: tuple[float, float]) -> Signs:
    """Return the stop, give-way and speed-limit signs of a map, in town coordinates: map + `offset_m` [m].

    A sign faces the traffic that it is for, by its orientation.
    """
    found, left = [], Counter[str]()
    for row in root.iterfind("road"):
        road = Road(row)
        for signal in row.iterfind("signals/signal"):
            name = signal.get("type", "")
            if name in PAINTED or signal.get("dynamic") == "yes":
                continue
            kind = SIGNS.get(name) or _limit_kind(signal)
            place = locate(road, signal, offset_m)
            if kind is None:
                left["a limit without a number" if name == LIMIT_SIGN else f"of the type {shorten(name)}"] += 1
                continue
            if place is None:
                left["no place on the road"] += 1
                continue
            x, y, heading = place
            facing = heading if signal.get("orientation") == "-" else heading + math.pi
            up = read_number(signal, "zOffset") + read_number(signal, "height") / 2
            found.append(
                SignParameters(
                    kind=kind,
                    x=round(x, 3),
                    y=round(y, 3),
                    yaw_deg=round(math.degrees(facing) % 360.0, 2),
                    height_m=round(up, 2) if PLATE_M[0] <= up <= PLATE_M[1] else SIGN_HEIGHT_M,
                )
            )
    return Signs(tuple(found), left)


def find_posts(root: ElementTree.Element, offset_m: tuple[float, float]) -> Posts:
    """Return the poles of a map with a height, in town coordinates: map + `offset_m` [m]."""
    found, left = [], Counter[str]()
    for row in root.iterfind("road"):
        road = Road(row)
        for thing in row.iterfind("objects/object"):
            height = read_number(thing, "height")
            if thing.get("type") != "pole":
                continue
            for one in repeat_object(thing):
                place = locate(road, one, offset_m)
                if not POST_M[0] <= height <= POST_M[1]:
                    left["no height of a pole"] += 1
                elif place is None:
                    left["no place on the road"] += 1
                else:
                    found.append(PostParameters(x=round(place[0], 3), y=round(place[1], 3), height_m=round(height, 2)))
    return Posts(tuple(found), left)


def read_limit(signal: ElementTree.Element) -> float | None:
    """Return the limit [m/s] of a speed-limit sign; None for other signs, and where it says no number."""
    value = read_number(signal, "value")
    if signal.get("type") != LIMIT_SIGN or not 5 <= value * KMH.get(signal.get("unit", "km/h"), 1.0) <= 200:
        return None
    return value * KMH.get(signal.get("unit", "km/h"), 1.0) / 3.6


def _limit_kind(signal: ElementTree.Element) -> Literal["speed_30", "speed_60", "speed_90"] | None:
    """Return the kind of sign that is nearest to a speed limit; None for other signs."""
    limit = read_limit(signal)
    return None if limit is None else SPEED_SIGNS[min(SPEED_SIGNS, key=lambda known: abs(known - 3.6 * limit))]
