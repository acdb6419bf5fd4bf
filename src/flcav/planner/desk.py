"""The desk of a planner: towns with their errors, an allocation problem, a finished run."""

import tempfile
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from flcav.config import InputError, Json, shorten
from flcav.interface.wording import plural
from flcav.optimization.problem import Problem
from flcav.planner.inputs import Sites, find_sites, read_given
from flcav.planner.placing import Kinds, Workspace
from flcav.planner.planning import describe_problem
from flcav.world.map.town import PACKAGED, TOWNS, Town, load_town
from flcav.world.opendrive.importing import import_town
from flcav.world.trace import Trace

if TYPE_CHECKING:
    from flcav.planner.footage import Footage  # loads torch, as runs do

RANGE_M = 40.0  # of the one kind of sensor, where none is given: as in the article
ONE_KIND = Kinds(("sensor",), (RANGE_M,), (0.0,))
MOST_OPEN = 50  # workspaces that are kept


@dataclass
class Desk:
    """The workspaces of a planner by key, and the problem and run that it was started with.

    Workspaces are added while it is served, never changed.
    """

    kinds: Kinds = ONE_KIND
    first: str | None = None  # key of the workspace to begin with
    problem: Problem | None = None
    problem_name: str = ""
    run: Mapping[str, Json] | None = None  # a finished run, as `replay` tells it
    footage: "Footage | None" = None  # what this run recorded
    spaces: dict[str, Workspace] = field(default_factory=dict)
    regions: dict[str, str] = field(default_factory=dict)  # by workspace, of the run: those whose errors have sweeps
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def find(self, key: str) -> Workspace:
        """Return the workspace of a key; raises `InputError` where there is none."""
        if key not in self.spaces:
            raise InputError(f"{shorten(key)} is not open here")
        return self.spaces[key]

    def add(self, space: Workspace, key: str = "") -> str:
        """Keep a workspace, and return its key: the town's name, and that of its table of errors."""
        key = key or (f"{space.town.name}~{Path(space.name).stem}" if space.name else space.town.name)
        with self._lock:
            if key not in self.spaces and len(self.spaces) >= MOST_OPEN:
                raise InputError(f"{MOST_OPEN} towns and tables are open: start the planner anew")
            self.spaces[key] = space
        return key

    def open_town(self, name: str) -> str:
        """Open a town of flcav, and return its key; raises `InputError` for another name, which is no path."""
        if name in self.spaces:
            return name
        if name not in PACKAGED:
            raise InputError(f"there is no town {shorten(name)}; there are {', '.join(PACKAGED)}")
        return self.add(lay_out(load_town(name)))

    def open_map(self, xodr: Path) -> str:
        """Import an OpenDRIVE map, and return the key of its town; raises `InputError` as `import_town` does."""
        return self.add(lay_out_map(xodr))

    def add_errors(self, key: str, table: Path) -> str:
        """Put the errors in a table into a copy of a workspace, and return its key; raises `InputError`."""
        if key not in self.spaces:
            raise InputError("open a town first: a table says where its errors are, not in which town")
        return self.add(with_errors(self.spaces[key], table))

    def describe(self) -> dict[str, Json]:
        """Return what a page begins with."""
        kinds = zip(self.kinds.names, self.kinds.ranges_m, self.kinds.costs, strict=True)
        return {
            "first": self.first,
            "kinds": [{"name": name, "range_m": range_m, "cost": cost} for name, range_m, cost in kinds],
            "towns": [] if self.first or self.problem or self.run else [describe_card(name) for name in TOWNS],
            "problem": None if self.problem is None else describe_problem(self.problem, self.problem_name),
            "run": self.run,
            "spaces": list(self.spaces),
        }


def describe_card(name: str) -> dict[str, Json]:
    """Return the card of a town: what it is, and its streets in small."""
    town = load_town(name)
    return {
        "name": name,
        "said": town.parameters.description,
        "told": f"{plural(len(town.poles.id), 'pole')}, {plural(len(town.buildings), 'building')}",
        "bounds": [round(float(value)) for value in town.bounds],
        "roads": [road.round().tolist() for road in town.roads],
    }


def lay_out(town: Town, traces: tuple[Trace, ...] = (), sites: Sites | None = None) -> Workspace:
    """Return a town without errors, its candidate sites those of `flcav place` unless they are given."""
    return Workspace(town, traces, sites or find_sites(town), typed=f"--town {town.name}")


def with_errors(space: Workspace, table: Path) -> Workspace:
    """Return a workspace with the errors in a table; raises `InputError` as `read_given` does."""
    given = read_given(table, None, None, RANGE_M, (), town=space.town)
    return replace(space, given=given, name=table.name, typed=f"--town {space.town.name} --errors {table.name}")


def lay_out_map(xodr: Path) -> Workspace:
    """Return the town of an OpenDRIVE map, imported into a temporary folder that stays as long as the process.

    Raises `InputError` where the map is none, or netconvert is not installed.
    """
    folder = tempfile.TemporaryDirectory(prefix="flcav-planner-")
    name = "".join(sign if sign.isascii() and (sign.isalnum() or sign in "-_") else "_" for sign in xodr.stem)
    town = import_town(xodr, Path(folder.name) / (name.lstrip("-_")[:60] or "map")).town
    _KEPT.append(folder)  # the net is read again for streets and sites
    return lay_out(town)


_KEPT: list[tempfile.TemporaryDirectory[str]] = []  # removed when the process ends
