"""Reading of an OpenDRIVE file and its attributes other than geometry: geo-reference, road types, limits, stops."""

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from flcav.config import SHOWN, InputError, read_xml, shorten
from flcav.world.opendrive.objects.signs import read_limit
from flcav.world.opendrive.standard import check_standard

FASTEST = 100.0  # highest speed limit that is believed [m/s]
STOP_SIGN = "206"  # type of a <signal>: its number in the German catalogue of signs, as in CARLA's maps
TO_METRES_PER_SECOND = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}
NUMBERED = re.compile(r"(road|unnamed|r)?[\s_-]*\d*", re.IGNORECASE)  # names that are none
LONGEST = 60  # characters of a street's name
OPEN_ROADS = ("rural", "motorway", "highway")  # types of roads outside towns


@dataclass(frozen=True)
class RoadType:
    """Type and speed limit of one road of the map."""

    kind: str  # type of the first <type>: town, rural, motorway, ...; "unknown" without one
    speed: float | None  # speed limit of the first <type>, else of the first speed-limit sign [m/s]; None without both
    name: str = ""  # of the street; empty where it has none, or only a number


@dataclass(frozen=True)
class MapOffset:
    """Transformation from a map's frame to the plane of its projection, <offset> (ASAM OpenDRIVE 1.8, 8.5)."""

    x: float = 0.0  # [m]
    y: float = 0.0  # [m]
    z: float = 0.0  # [m]
    hdg: float = 0.0  # rotation before the translation, counter-clockwise [rad]

    def apply(self, x: float, y: float) -> tuple[float, float]:
        """Transform the point (x, y) [m] of the map to the plane of its projection [m]."""
        cos, sin = math.cos(self.hdg), math.sin(self.hdg)
        return x * cos - y * sin + self.x, x * sin + y * cos + self.y


UNMOVED = MapOffset()


@dataclass(frozen=True)
class Document:
    """The attributes of an OpenDRIVE file that the import needs besides geometry."""

    geo_reference: str  # PROJ string or EPSG code; empty without one
    offset: MapOffset  # NaN where the file has no number
    roads: dict[str, RoadType]  # road id -> its type and limit
    stops: frozenset[str]  # ids of the junctions with a stop sign
    left_hand: bool  # whether most roads have left-hand traffic


def read_map(path: Path) -> ElementTree.Element:
    """Read an OpenDRIVE file, check it and return its root, the element names without a namespace.

    Raises `InputError` where the file is missing, is no map of version 1, or breaks a rule of `standard`.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected an OpenDRIVE file (.xodr)")
    root = read_xml(path, "an OpenDRIVE map")
    drop_namespaces(root)
    if root.tag.lower() != "opendrive":
        raise InputError(
            f"{path}: not an OpenDRIVE map (its root is <{root.tag[:SHOWN]}>, expected <OpenDRIVE>: OpenDRIVE 1.8, 6.4)"
        )
    header = root.find("header")
    version = "1" if header is None else header.get("revMajor", "")  # a map can do without a header
    if version != "1":
        raise InputError(f"{path}: OpenDRIVE version {shorten(version)} is not supported; supported: 1.x")
    if root.find("road") is None:
        raise InputError(f"{path}: has no <road> (OpenDRIVE 1.8, 10.1)")
    if root.find(".//include") is not None:
        raise InputError(
            f"{path}: includes other files, which are not read: put their content in the place of <include>"
        )
    check_standard(root, path)
    return root


def drop_namespaces(root: ElementTree.Element) -> None:
    """Remove the namespace from the names of all elements, in place: only version 1.8 has one."""
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]


def describe_map(root: ElementTree.Element) -> Document:
    """Read the attributes of the map below `root`."""
    rows = root.findall("road")
    left = sum(row.get("rule") == "LHT" for row in rows)
    return Document(
        (root.findtext("header/geoReference") or "").strip(),
        _offset(root.find("header/offset")),
        {row.get("id", ""): _road(row) for row in rows},
        frozenset(junction for row in rows for junction in _stops(row)),
        left_hand=2 * left > len(rows),
    )


def _offset(row: ElementTree.Element | None) -> MapOffset:
    if row is None:
        return UNMOVED
    try:
        return MapOffset(*(float(row.get(name, "0")) for name in ("x", "y", "z", "hdg")))
    except ValueError:
        return MapOffset(math.nan)


def _road(row: ElementTree.Element) -> RoadType:
    limits = [limit for signal in row.iterfind("signals/signal") if (limit := read_limit(signal)) is not None]
    signed = limits[0] if limits else None
    first, name = row.find("type"), " ".join(row.get("name", "").split())
    name = name if name.isprintable() and len(name) <= LONGEST and not NUMBERED.fullmatch(name) else ""
    if first is None:
        return RoadType("unknown", signed, name)
    limit = first.find("speed")
    try:
        speed = float(limit.get("max", "")) * TO_METRES_PER_SECOND[limit.get("unit", "m/s")] if limit is not None else 0
    except (ValueError, KeyError):
        speed = 0.0  # "no limit", "undefined"
    return RoadType(first.get("type", "unknown"), speed if 0 < speed <= FASTEST else signed, name)


def _stops(row: ElementTree.Element) -> list[str]:
    """List the ids of the junctions at a road's stop signs: the one that the road is in, or else the one ahead."""
    out = []
    for signal in row.iterfind("signals/signal"):
        if signal.get("type") != STOP_SIGN:
            continue
        if row.get("junction", "-1") != "-1":
            out.append(row.attrib["junction"])
            continue
        end = "successor" if signal.get("orientation", "+") == "+" else "predecessor"
        link = row.find(f"link/{end}")
        if link is not None and link.get("elementType") == "junction":
            out.append(link.get("elementId", ""))
    return out
