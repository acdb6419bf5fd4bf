"""Objects and signals along the roads of an OpenDRIVE map that a town takes over, in one record."""

import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from flcav.world.map.parameters import (
    ObjectParameters,
    ParkingParameters,
    PostParameters,
    SignalParameters,
    SignParameters,
    StopLineParameters,
)
from flcav.world.map.roads import RoadNet
from flcav.world.opendrive.objects.parking_spaces import find_parking
from flcav.world.opendrive.objects.signal_heads import count_controllers, find_heads
from flcav.world.opendrive.objects.signs import find_posts, find_signs
from flcav.world.opendrive.objects.standing import find_objects
from flcav.world.opendrive.objects.stop_lines import add_crossing_lines, find_stop_lines, stop_at_lines


@dataclass(frozen=True)
class MapObjects:
    """The objects and signals of a map in town coordinates, and notes on how many there are."""

    signs: tuple[SignParameters, ...]
    limits: bool  # whether there are speed-limit signs in the map, among `signs` or left out
    posts: tuple[PostParameters, ...]
    objects: tuple[ObjectParameters, ...]
    signals: tuple[SignalParameters, ...]
    stop_lines: tuple[StopLineParameters, ...]
    parking: tuple[ParkingParameters, ...]
    notes: tuple[str, ...]  # sentences


def take_objects(
    root: ElementTree.Element, offset_m: tuple[float, float], net: RoadNet, path: Path, *, crosswalks: bool
) -> MapObjects:
    """Return what a map has along the roads of `net`, and write where vehicles stop into its file, `path`.

    Town = map + `offset_m` [m]; `crosswalks` are those of the map.
    """
    heads = find_heads(root, offset_m, net)
    parking = find_parking(root, offset_m, net)
    objects = find_objects(root, offset_m, net)
    signs, posts = find_signs(root, offset_m), find_posts(root, offset_m)
    found = find_stop_lines(root, offset_m, net)
    lines = add_crossing_lines(net, found.found) if crosswalks else found.found
    stop_at_lines(path, lines)
    several, alike = count_controllers(heads.found, path)
    told = f"Controllers with several of these heads: {several}; switched alike here: {alike}."
    return MapObjects(
        signs=signs.found,
        limits=signs.limits,
        posts=posts.found,
        objects=objects.found,
        signals=heads.found,
        stop_lines=lines,
        parking=parking.found,
        notes=(
            *tell("Signs", len(signs.found), signs.left),
            *tell("Poles", len(posts.found), posts.left),
            *tell("Signal heads", len(heads.found), heads.left),
            *tell("Stop lines", found.taken, found.left),
            *tell("Parking spaces", len(parking.found), parking.left),
            *tell("Buildings, plants, barriers and obstacles", objects.taken, objects.left),
            *([told] if several else []),
        ),
    )


def tell(what: str, taken: int, left: Counter[str]) -> list[str]:
    """Return a sentence on how many of a map's things were taken over, and why others were not; none without any."""
    if not taken and not left:
        return []
    told = "".join(f"; left out: {count} ({reason})" for reason, count in sorted(left.items()))
    return [f"{what} of the map taken over: {taken}{told}."]
