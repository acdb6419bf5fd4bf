"""SUMO's netconvert as a process: from OpenDRIVE to plain parts, and from plain parts to a net."""

import importlib.util
import re
import subprocess
from pathlib import Path

from flcav.config import InputError
from flcav.extras import installation

PARTS = ("nod", "edg", "con")
OPTIONS = {"nod": "node-files", "edg": "edge-files", "con": "connection-files"}
JOINING = {
    "offset.disable-normalization": "true",
    "no-turnarounds.except-deadend": "true",
    "geometry.remove": "true",  # a node between two stretches of one street becomes a bend of it,
    "geometry.remove.min-length": "40",  # even where a short one differs a little from the other
    "geometry.remove.width-tolerance": "1",
    "keep-edges.components": "1",
    "crossings.guess": "true",
    "crossings.guess.speed-threshold": "20",
    "walkingareas": "true",
    "junctions.corner-detail": "8",
    "junctions.internal-link-detail": "12",
    "roundabouts.guess": "true",
    "tls.default-type": "static",
    "tls.cycle.time": "60",
}


def take_apart(xodr: Path, prefix: Path) -> None:
    """Write the nodes, edges and connections of an OpenDRIVE map beside `prefix`, e.g. `prefix.nod.xml`, and a net.

    Heights are dropped: towns are flat. Raises `InputError` where netconvert refuses the map.
    """
    options = {
        "opendrive-files": str(xodr),
        "opendrive.import-all-lanes": "true",
        "flatten": "true",
        "offset.disable-normalization": "true",
        "plain-output-prefix": str(prefix),
        "output-file": f"{prefix}.net.xml",
    }
    _run(options, xodr)


def join(prefix: Path, net: Path, origin: Path) -> None:
    """Join the parts beside `prefix` to the net file `net`; raises `InputError` naming `origin` where they cannot."""
    options = {OPTIONS[part]: f"{prefix}.{part}.xml" for part in PARTS}
    _run(options | JOINING | {"output-file": str(net)}, origin)
    text = net.read_text(encoding="utf-8")
    net.write_text(re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL), encoding="utf-8")  # dates and paths


def _run(options: dict[str, str], origin: Path) -> None:
    found = importlib.util.find_spec("sumo")
    if found is None or not found.submodule_search_locations:
        raise InputError(f"importing towns needs SUMO's netconvert, which is not installed: {installation('towns')}")
    binary = Path(next(iter(found.submodule_search_locations))) / "bin" / "netconvert"
    command = [str(binary), *(word for name, value in options.items() for word in (f"--{name}", value))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        errors = re.findall(r"Error: (.*)", done.stderr) or [done.stderr.strip() or f"exit code {done.returncode}"]
        raise InputError(f"{origin}: netconvert cannot read this OpenDRIVE map ({errors[0].strip().rstrip('.')})")
