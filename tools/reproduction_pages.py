"""The tables of a reproduction's page, from its numbers: python tools/reproduction_pages.py reproductions/NAME.

A page (README.md) marks where they go, `<!-- NAME -->` to `<!-- end -->`; what stands between is replaced by what the
folder's result.json says, or its results.json, where the page is of a run (`flcav run`). The words around the tables
are the authors'.
"""

import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flcav.config import InputError
from flcav.experiments import (
    arms_tables,
    fig3a_tables,
    fig6a_tables,
    objects_tables,
    run_tables,
    signs_tables,
    sim_to_real_tables,
    trajectory_tables,
    weather_tables,
)
from flcav.files import write_bytes
from flcav.pipeline.results import Run
from flcav.pipeline.running import RESULTS

Tables = Mapping[str, str]
TABLES: dict[str, Callable[[Mapping[str, Any]], Tables]] = {
    "demo": arms_tables.tables,
    "fig3a": fig3a_tables.tables,
    "fig6a-allocation": fig6a_tables.tables,
    "sim-to-real": sim_to_real_tables.tables,
    "task-objects": objects_tables.tables,
    "task-signs": signs_tables.tables,
    "task-trajectory": trajectory_tables.tables,
    "task-trajectory-cameras": trajectory_tables.tables,
    "task-weather": weather_tables.tables,
}
_SPAN = re.compile(r"<!-- (?P<name>[a-z ]+) -->\n.*?<!-- end -->", re.DOTALL)


def fill(page: str, tables: Tables) -> str:
    """Return `page` with what stands between its marks replaced by the tables of those names; raises `InputError`."""

    def filled(span: re.Match[str]) -> str:
        name = span["name"]
        if name not in tables:
            raise InputError(f"page: no table {name!r}, only {', '.join(tables)}")
        return f"<!-- {name} -->\n{tables[name]}\n<!-- end -->"

    return _SPAN.sub(filled, page)


def tables_of(folder: Path) -> Tables:
    """Return the tables of a reproduction, by name."""
    if (folder / RESULTS).is_file():
        return run_tables.tables(Run.load(folder, RESULTS))
    return TABLES[folder.name](json.loads((folder / "result.json").read_text(encoding="utf-8")))


def fill_folder(folder: Path) -> str:
    """Return the page of a reproduction as its numbers have it."""
    return fill((folder / "README.md").read_text(encoding="utf-8"), tables_of(folder))


def main(folders: Sequence[str]) -> None:
    """Fill the pages of the folders anew."""
    for folder in map(Path, folders):
        write_bytes(folder / "README.md", fill_folder(folder).encode())


if __name__ == "__main__":
    main(sys.argv[1:])
