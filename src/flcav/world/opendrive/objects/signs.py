"""Signs and poles of an OpenDRIVE map with a known type and place (OpenDRIVE 1.8, 13 and 14)."""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import dataclass
from typing import Literal

from flcav.config import shorten
from flcav.world.map.parameters import PostParameters, SignParameters
from flcav.world.map.street_furniture import SIGN_HEIGHT_M, SPEED_SIGNS
from flcav.world.opendrive.objects.crossings import PAINTED_CROSSWALK
from flcav.world.opendrive.objects.places import TakenOver, list_objects, locate_thing, read_number, repeat_object
from flcav.world.opendrive.objects.stop_lines import PAINTED_STOP_LINE
from flcav.world.opendrive.road_surface import Road

SIGNS: dict[str, Literal["stop", "yield"]] = {"206": "stop", "205": "yield"}  # number in the German catalogue -> kind
LIMIT_SIGN = "274"  # number of a speed-limit sign there
KMH = {"km/h": 1.0, "mph": 1.609344, "m/s": 3.6}  # unit -> km/h
LIMITS_KMH = (5.0, 200.0)  # least and largest speed limit that is believed
PLATE_M = (1.2, 4.5)  # least and largest height of a plate's centre that is believed
POST_M = (0.3, 15.0)  # least and largest height of a pole that is taken over
PAINTED = (PAINTED_CROSSWALK, PAINTED_STOP_LINE)  # types of signals that are markings on the road


@dataclass(frozen=True)
class MappedSigns(TakenOver[SignParameters]):
    """The signs of a map."""

    limits: bool = False  # whether the map has speed-limit signs, taken over or left out


def find_signs(root: ElementTree.Element, offset_m: tuple[float, float]) -> MappedSigns:
    """Find the stop, give-way and speed-limit signs of the map below `root`.

    A place in the town is that in the map + `offset_m` (x, y) [m]. A sign faces the traffic of its orientation. Left
    out are signs of other types, limits without a number or without a sign for it, and signs without a place on their
    road.
    """
    found, left, limits = [], Counter[str](), False
    for row in root.iterfind("road"):
        road = Road(row)
        for signal in row.iterfind("signals/signal"):
            name = signal.get("type", "")
            if name in PAINTED or signal.get("dynamic") == "yes":
                continue
            limits |= name == LIMIT_SIGN
            limit = read_limit(signal)
            kind = SIGNS.get(name) or _limit_kind(limit)
            place = locate_thing(road, signal, offset_m)
            if kind is None:
                left[f"of the type {shorten(name)}" if name != LIMIT_SIGN else _explain_limit(limit)] += 1
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
    return MappedSigns(tuple(found), left, limits=limits)


def find_map_poles(root: ElementTree.Element, offset_m: tuple[float, float]) -> TakenOver[PostParameters]:
    """Find the poles with a height of the map below `root`; a place in the town is that in the map + `offset_m` [m]."""
    found = []
    left = Counter[str]()
    for road, thing in list_objects(root, lambda thing: thing.get("type") == "pole"):
        height = read_number(thing, "height")
        for one in repeat_object(thing):
            place = locate_thing(road, one, offset_m)
            if not POST_M[0] <= height <= POST_M[1]:
                left["no height of a pole"] += 1
            elif place is None:
                left["no place on the road"] += 1
            else:
                found.append(PostParameters(x=round(place[0], 3), y=round(place[1], 3), height_m=round(height, 2)))
    return TakenOver(tuple(found), left)


def read_limit(signal: ElementTree.Element) -> float | None:
    """Read the limit [m/s] of a speed-limit sign; None for other signs, and without a number in a known unit.

    A number without a unit is in km/h.
    """
    limit = read_number(signal, "value") * KMH.get(signal.get("unit") or "km/h", 0.0)
    return limit / 3.6 if signal.get("type") == LIMIT_SIGN and LIMITS_KMH[0] <= limit <= LIMITS_KMH[1] else None


def _limit_kind(limit: float | None) -> Literal["speed_30", "speed_60", "speed_90"] | None:
    """Return the kind of sign that shows a limit [m/s]; None without such a kind, and without a limit."""
    return None if limit is None else SPEED_SIGNS.get(round(3.6 * limit))


def _explain_limit(limit: float | None) -> str:
    """Write the reason why the sign of a limit [m/s] is left out."""
    return "a limit without a number" if limit is None else f"a limit of {3.6 * limit:.0f} km/h, which no sign shows"
