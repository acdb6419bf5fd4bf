"""Mirroring of an OpenDRIVE map in the x axis: left-hand traffic becomes right-hand traffic, and the reverse."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

SIDES = {"left": "right", "right": "left"}
ORDER = {"left": 0, "center": 1, "right": 2}
TURNED: dict[str, tuple[str, ...]] = {  # attributes that change their sign, by element
    "geometry": ("y", "hdg"),
    "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"),
    "poly3": tuple("abcd"),
    "paramPoly3": ("aV", "bV", "cV", "dV"),
    "superelevation": tuple("abcd"),
    "laneOffset": tuple("abcd"),
    "signal": ("t", "hOffset"),
    "object": ("t", "hdg"),
    "repeat": ("tStart", "tEnd"),
    "cornerLocal": ("v",),
    "cornerRoad": ("t",),
    "lane": ("id",),
    "laneLink": ("from", "to"),
}


def mirror_map(root: ElementTree.Element) -> None:
    """Mirror the map below `root` in place, y to -y; the rule of each road, RHT or LHT, changes too.

    Lateral shapes are removed.
    """
    for row in root.iter():
        for name in TURNED.get(row.tag, ()):
            if name in row.attrib:
                row.set(name, _turn(row.attrib[name]))
    for road in root.iterfind("road"):
        road.set("rule", "RHT" if road.get("rule") == "LHT" else "LHT")
        lateral = road.find("lateralProfile")
        for shape in [] if lateral is None else lateral.findall("shape"):
            lateral.remove(shape)  # pyright: ignore[reportOptionalMemberAccess]
        for section in road.iterfind("lanes/laneSection"):
            for side in section:
                side.tag = SIDES.get(side.tag, side.tag)
            section[:] = sorted(section, key=lambda side: ORDER.get(side.tag, len(ORDER)))
        for end in road.iterfind("lanes/laneSection/*/lane/link/*"):
            if "id" in end.attrib:
                end.set("id", _turn(end.attrib["id"]))


def mirror_parts(prefix: Path) -> None:
    """Mirror netconvert's plain nodes, edges and connections beside `prefix` in place, y to -y."""
    for part in ("nod", "edg", "con"):
        tree = ElementTree.parse(f"{prefix}.{part}.xml")
        for row in tree.getroot().iter():
            if "y" in row.attrib:
                row.set("y", _turn(row.attrib["y"]))
            if "shape" in row.attrib:
                points = [point.split(",") for point in row.attrib["shape"].split()]
                row.set("shape", " ".join(f"{x},{_turn(y)}" for x, y, *_ in points))
        tree.write(f"{prefix}.{part}.xml")


def _turn(text: str) -> str:
    """Return a number as text with the other sign."""
    stripped = text.strip()
    return stripped[1:] if stripped.startswith("-") else f"-{stripped.removeprefix('+')}"
