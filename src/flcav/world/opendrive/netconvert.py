"""SUMO's netconvert, a program of the extra `towns`: maps as it needs them, its run, and its plain files."""

import copy
import importlib
import importlib.util
import re
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from flcav.config import InputError
from flcav.interface.wording import format_install_command
from flcav.world.opendrive.objects.crossings import Crosswalk, take_crosswalks

PARTS = ("nod", "edg", "con")  # netconvert's plain XML files: nodes, edges, connections
OPTIONS = {"nod": "node-files", "edg": "edge-files", "con": "connection-files"}
JOINING = {
    "offset.disable-normalization": "true",
    "no-turnarounds.except-deadend": "true",
    "walkingareas": "true",
    "junctions.corner-detail": "8",
    "junctions.internal-link-detail": "12",
    "roundabouts.guess": "true",
    "tls.default-type": "static",
    "tls.cycle.time": "60",
}
FIRST = {
    "geometry.remove": "true",  # merge the edges at a node of one street,
    "geometry.remove.min-length": "40",  # and a short edge even where it differs a little
    "geometry.remove.width-tolerance": "1",
    "crossings.guess": "true",
    "crossings.guess.speed-threshold": "20",
}
NAMES = {  # attributes that refer to a road or junction by its id
    "road": ("incomingRoad", "connectingRoad", "linkedRoad", "high", "low"),
    "junction": ("junction",),
}
UNSAFE = re.compile(r"[^A-Za-z0-9_.-]")  # what ids of SUMO's nodes and edges are without here
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
    """Return a number, as text, with its sign inverted."""
    stripped = text.strip()
    return stripped[1:] if stripped.startswith("-") else f"-{stripped.removeprefix('+')}"


def split_map(root: ElementTree.Element, prefix: Path, origin: Path, *, left_hand: bool) -> None:
    """Split the map below `root`: write its `PARTS` as `prefix.nod.xml` and so on, and its net as `prefix.net.xml`.

    They are plane: heights are read on their own. netconvert knows no left-hand traffic in OpenDRIVE; such a map is
    mirrored for it, and its parts are mirrored back. Raises `InputError` naming `origin` where netconvert is missing or
    refuses the map.
    """
    plan = copy.deepcopy(root)
    for road in plan.iterfind("road"):
        for objects in road.findall("objects"):
            road.remove(objects)
    for header in plan.iterfind("header"):
        for reference in header.findall("geoReference"):  # netconvert refuses one that PROJ does not know
            header.remove(reference)
    if left_hand:
        mirror_map(plan)
    xodr = prefix.with_suffix(".xodr")
    ElementTree.ElementTree(plan).write(xodr, encoding="utf-8", xml_declaration=True)
    options = {
        "opendrive-files": xodr.name,
        "opendrive.import-all-lanes": "true",
        "opendrive.internal-shapes": "true",  # lanes inside junctions are the connecting roads
        "opendrive.curve-resolution": "1",  # [m] between the points of a curve
        "flatten": "true",
        "offset.disable-normalization": "true",
        "plain-output-prefix": prefix.name,
        "output-file": f"{prefix.name}.net.xml",
    }
    run_netconvert(options, prefix.parent, origin)
    if left_hand:
        mirror_parts(prefix)


def join_parts(
    prefix: Path, net: Path, origin: Path, *, left_hand: bool, crosswalks: tuple[Crosswalk, ...] = ()
) -> int:
    """Join the `PARTS` beside `prefix` to the net file `net`; return how many of a map's crosswalks are its crossings.

    Without `crosswalks` netconvert guesses where crossings are. Raises `InputError` naming `origin` where that fails.
    """
    side = {"lefthand": "true"} if left_hand else {}
    plain, made = prefix.with_name("joined"), prefix.with_name("joined.net.xml")
    side |= {"output-file": made.name}
    also = {"plain-output-prefix": plain.name} if crosswalks else {}
    run_netconvert(_name_parts(prefix) | JOINING | FIRST | side | also, prefix.parent, origin)
    taken = 0
    if crosswalks:
        taken = take_crosswalks(plain, made, crosswalks)
        run_netconvert(_name_parts(plain) | JOINING | side, prefix.parent, origin)
    text = made.read_text(encoding="utf-8")
    net.write_text(re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL), encoding="utf-8")  # no dates and paths
    return taken


def _name_parts(prefix: Path) -> dict[str, str]:
    """Return netconvert's options for reading the `PARTS` beside `prefix`."""
    return {OPTIONS[part]: f"{prefix.name}.{part}.xml" for part in PARTS}


def name_safely(root: ElementTree.Element) -> None:
    """Replace characters that SUMO's ids cannot have in the ids of roads and junctions below `root`, in place."""
    for kind, references in NAMES.items():
        known = {row.get("id", "") for row in root.iterfind(kind)}
        safe: dict[str, str] = {}
        for name in sorted(name for name in known if UNSAFE.search(name)):
            safe[name] = UNSAFE.sub("_", name)
            while safe[name] in known:
                safe[name] += "_"
            known.add(safe[name])
        for row in root.iter() if safe else ():
            own = ("id",) if row.tag == kind else ("elementId",) if row.get("elementType") == kind else ()
            for attribute in (*own, *references):
                if row.get(attribute) in safe:
                    row.set(attribute, safe[row.attrib[attribute]])
