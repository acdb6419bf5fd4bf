"""What an OpenDRIVE file says beside its geometry: where on Earth it is, how fast its roads are, where one stops."""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from flcav.config import InputError

STOP_SIGN = "206"  # types of <signal>, after the German catalogue of signs, which CARLA's maps go by
TO_METRES_PER_SECOND = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}
OPEN_ROADS = ("rural", "motorway", "highway")


@dataclass(frozen=True)
class Road:
    """A road of the map."""

    kind: str  # of the first <type>: town, rural, motorway, ...; "unknown" where there is none
    speed: float | None  # limit [m/s]


@dataclass(frozen=True)
class Document:
    """The parts of an OpenDRIVE file that are read here."""

    geo_reference: str  # a PROJ string; empty where there is none
    roads: dict[str, Road]
    stops: frozenset[str]  # junctions with a stop sign


def read_document(path: Path) -> Document:
    """Return what is in the file; raises `InputError` where it is no OpenDRIVE map of version 1."""
    try:
        root = ElementTree.parse(path).getroot()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, expected an OpenDRIVE file (.xodr)") from None
    except (ElementTree.ParseError, UnicodeDecodeError, LookupError, ValueError) as error:
        raise InputError(f"{path}: not an OpenDRIVE map ({error})") from None
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # version 1.8 has a namespace, earlier ones do not
    header = root.find("header")
    if root.tag.lower() != "opendrive" or header is None:
        raise InputError(
            f"{path}: not an OpenDRIVE map (its root is <{root.tag}>, expected <OpenDRIVE> with a <header>)"
        )
    if header.get("revMajor") != "1":
        raise InputError(f"{path}: OpenDRIVE version {header.get('revMajor')!r} is not supported; supported: 1.x")
    rows = root.findall("road")
    if not rows:
        raise InputError(f"{path}: has no <road>")
    return Document(
        (header.findtext("geoReference") or "").strip(),
        {row.get("id", ""): _road(row) for row in rows},
        frozenset(junction for row in rows for junction in _stops(row)),
    )


def _road(row: ElementTree.Element) -> Road:
    first = row.find("type")
    if first is None:
        return Road("unknown", None)
    limit = first.find("speed")
    try:
        speed = float(limit.get("max", "")) * TO_METRES_PER_SECOND[limit.get("unit", "m/s")] if limit is not None else 0
    except (ValueError, KeyError):
        speed = 0.0  # "no limit", "undefined"
    return Road(first.get("type", "unknown"), speed or None)


def _stops(row: ElementTree.Element) -> list[str]:
    """Return the junctions that the stop signs of a road stand at."""
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
