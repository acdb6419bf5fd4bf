"""Runs of SUMO's netconvert, a program of the extra `towns`: preparation of maps for it, options, and plain files."""

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
OPTIONS = {"nod": "node-files", "edg": "edge-files", "con": "connection-files"}  # part -> netconvert's option for it
JOINING = {  # options of both runs that join parts to a net
    "offset.disable-normalization": "true",
    "no-turnarounds.except-deadend": "true",
    "walkingareas": "true",
    "junctions.corner-detail": "8",
    "junctions.internal-link-detail": "12",
    "roundabouts.guess": "true",
    "tls.default-type": "static",
    "tls.cycle.time": "60",
}
FIRST = {  # further options of the first of these runs
    "geometry.remove": "true",  # merge the edges of a street at a node where they are alike
    "geometry.remove.min-length": "40",  # merge edges that are shorter even where they differ a little
    "geometry.remove.width-tolerance": "1",
    "crossings.guess": "true",
    "crossings.guess.speed-threshold": "20",
}
NAMES = {  # element -> attributes that refer to it by its id
    "road": ("incomingRoad", "connectingRoad", "linkedRoad", "high", "low"),
    "junction": ("junction",),
}
UNSAFE = re.compile(r"[^A-Za-z0-9_.-]")  # characters that are replaced in ids of SUMO's nodes and edges
NETCONVERT_S = 300.0  # time limit of a run of netconvert


def run_netconvert(options: dict[str, str], folder: Path, origin: Path) -> None:
    """Run netconvert in `folder` with `options`; raises `InputError` where it is missing, or with its first error.

    Options name files relative to `folder`, since netconvert takes a comma in a path for a separator. `origin` names
    the map in the error.
    """
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise InputError(
            f"OpenDRIVE maps need SUMO's netconvert, which is not installed: {format_install_command('towns')}"
        )
    binary = Path(next(iter(spec.submodule_search_locations))) / "bin" / "netconvert"
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


SIDES = {"left": "right", "right": "left"}  # side of a lane section -> its mirror image
ORDER = {"left": 0, "center": 1, "right": 2}  # order of the sides in a lane section
TURNED: dict[str, tuple[str, ...]] = {  # element -> attributes that change their sign in a mirrored map
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
    """Mirror the map below `root` in place, y to -y; the traffic rule of roads, RHT or LHT, is swapped too.

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
    """Mirror netconvert's plain nodes, edges and connections `prefix.nod.xml` and so on in place, y to -y."""
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
    """Invert the sign of a number given as text."""
    stripped = text.strip()
    return stripped[1:] if stripped.startswith("-") else f"-{stripped.removeprefix('+')}"


def split_map(root: ElementTree.Element, prefix: Path, origin: Path, *, left_hand: bool) -> None:
    """Split the map below `root`: write its `PARTS` as `prefix.nod.xml` and so on, and its net as `prefix.net.xml`.

    The parts are plane; `heights` reads the heights separately. netconvert supports no left-hand traffic in OpenDRIVE:
    such a map is mirrored for it, and the parts are mirrored back. Raises `InputError` naming `origin` where netconvert
    is missing or refuses the map.
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
    """Join the `PARTS` of `prefix` to the net file `net`; return the number of crosswalks that became crossings.

    Without `crosswalks` netconvert guesses where crossings are. Raises `InputError` naming `origin` where it fails.
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
    """Build netconvert's options for reading the `PARTS` of `prefix`."""
    return {OPTIONS[part]: f"{prefix.name}.{part}.xml" for part in PARTS}


def name_safely(root: ElementTree.Element) -> None:
    """Replace `UNSAFE` characters in the ids of roads and junctions below `root`, and in references to them."""
    for kind, references in NAMES.items():
        known = {row.get("id", "") for row in root.iterfind(kind)}
        safe: dict[str, str] = {}
        for name in sorted(name for name in known if UNSAFE.search(name)):
            safe[name] = UNSAFE.sub("_", name)
            while safe[name] in known:
                safe[name] += "_"
            known.add(safe[name])
        for row in root.iter() if safe else ():
            id_attributes = ("id",) if row.tag == kind else ("elementId",) if row.get("elementType") == kind else ()
            for attribute in (*id_attributes, *references):
                if row.get(attribute) in safe:
                    row.set(attribute, safe[row.attrib[attribute]])
