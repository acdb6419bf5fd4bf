"""SUMO's netconvert, which reads and writes OpenDRIVE maps: a program of the extra `towns`."""

import importlib
import importlib.util
import re
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from flcav.config import InputError
from flcav.interface.wording import format_install_command

NETCONVERT_S = 300.0  # longest run of netconvert


def run_netconvert(options: dict[str, str], folder: Path, origin: Path) -> None:
    """Run netconvert in `folder`; raises `InputError` where it is missing, or with its first error where it fails.

    Options name files by their names there: in a path it would take a comma for a separator.
    """
    found = importlib.util.find_spec("sumo")
    if found is None or not found.submodule_search_locations:
        raise InputError(
            f"OpenDRIVE maps need SUMO's netconvert, which is not installed: {format_install_command('towns')}"
        )
    binary = Path(next(iter(found.submodule_search_locations))) / "bin" / "netconvert"
    command = [str(binary), *(word for name, value in options.items() for word in (f"--{name}", value))]
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, errors="replace", check=False, timeout=NETCONVERT_S
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"{origin}: netconvert did not come to an end with this map in {NETCONVERT_S:.0f} s") from None
    if done.returncode:
        errors = re.findall(r"Error: (.*)", done.stderr) or [f"exit code {done.returncode}"]
        raise InputError(f"{origin}: netconvert cannot read this OpenDRIVE map ({errors[0].strip().rstrip('.')})")


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
