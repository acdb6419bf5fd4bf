"""Crosswalks of an OpenDRIVE map: objects with an outline, and markings that are signals (OpenDRIVE 1.8, 13 and 14)."""

import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.world.opendrive.objects.places import enclose_outline, locate, outline_object, read_number
from flcav.world.opendrive.road_surface import Road

Array = NDArray[np.float64]

MARKING = "1000003"  # type of a signal that is a painted crosswalk: its width is that across the road,
WIDE_M = (1.0, 15.0)  # its value that of the walkers' way; widths that are believed
LONG_M = (2.0, 60.0)  # lengths of a crosswalk that are believed


@dataclass(frozen=True)
class Crosswalk:
    """A crosswalk of the map, as the rectangle around it."""

    centre: Array  # (2,) town [m]
    axes: Array  # (2, 2) unit vectors along its sides, one a row
    sides: Array  # (2,) lengths of these sides [m]

    def along(self, walked: Array) -> tuple[Array, float, float]:
        """Return the unit vector of the walkers' way, its length and its width [m].

        It is that axis which is nearest to the direction `walked` (2,), and points along it.
        """
        share = self.axes @ walked
        first = int(np.argmax(np.abs(share)))
        return self.axes[first] * np.sign(share[first]), float(self.sides[first]), float(self.sides[1 - first])


@dataclass(frozen=True)
class Crosswalks:
    """The crosswalks that a map describes, and how many it only names, by the reason."""

    found: tuple[Crosswalk, ...]
    left: Counter[str]


def find_crosswalks(root: ElementTree.Element, offset_m: tuple[float, float]) -> Crosswalks:
    """Return the crosswalks of a map in town coordinates: map + `offset_m` [m]."""
    found, left = [], Counter[str]()
    for row in root.iterfind("road"):
        named = [thing for thing in row.iterfind("objects/object") if thing.get("type") == "crosswalk"]
        painted = [signal for signal in row.iterfind("signals/signal") if signal.get("type") == MARKING]
        if not named and not painted:
            continue
        road = Road(row)
        for outline in [outline_object(road, thing) for thing in named] + [_outline(road, one) for one in painted]:
            if outline is None:
                left["no place or outline"] += 1
                continue
            crosswalk = _enclose(outline + offset_m)
            if crosswalk is None:
                left["no size of a crosswalk"] += 1
            else:
                found.append(crosswalk)
    return Crosswalks(tuple(found), left)


def _outline(road: Road, marking: ElementTree.Element) -> Array | None:
    """Return the corners (4, 2) of a crosswalk that is a signal; None where it lacks its place or extents."""
    place = locate(road, marking)
    across, along = read_number(marking, "width"), read_number(marking, "value")
    if place is None or not (LONG_M[0] <= across <= LONG_M[1] and WIDE_M[0] <= along <= WIDE_M[1]):
        return None
    forward = np.array([np.cos(place[2]), np.sin(place[2])])
    left = np.array([-forward[1], forward[0]])
    return place[:2] + np.array([a * along / 2 * forward + b * across / 2 * left for a, b in CORNERS])


CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))


def _enclose(outline: Array) -> Crosswalk | None:
    """Return the smallest rectangle around an outline (K, 2); None where its sides are not those of a crosswalk."""
    found = enclose_outline(outline)
    if found is None:
        return None
    sides = found.sides
    if not (WIDE_M[0] <= sides.min() <= WIDE_M[1] and LONG_M[0] <= sides.max() <= LONG_M[1]):
        return None
    return Crosswalk(found.centre, found.edges / sides[:, None], sides)
