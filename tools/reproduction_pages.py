"""Fill the tables of a reproduction's page from its numbers: python tools/reproduction_pages.py reproductions/NAME.

A page (README.md) marks a table's place by `<!-- NAME -->` and `<!-- end -->`; the text between is replaced by the
table of that name, made from the folder's result.json, or from results.json where the page is of a run (`flcav run`);
where it is of a run's seeds, from theirs and summary.json. A page of both has the run's tables as `<!-- run NAME -->`.
All other text stays.
"""

import functools
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from flcav.config import InputError, read_json
from flcav.experiments.experiment import load_experiment
from flcav.report import run_tables, seed_tables
from flcav.runs.results.run import Run, Summary
from flcav.runs.running import RESULTS
from flcav.storage.files import write_bytes

Tables = Mapping[str, str]
_SPAN = re.compile(r"<!-- (?P<name>[a-z ]+) -->\n.*?<!-- end -->", re.DOTALL)


def fill(page: str, tables: Tables) -> str:
    """Return `page` with the text between marks replaced by the named tables; raises `InputError` for unknown names."""

    def filled(span: re.Match[str]) -> str:
        name = span["name"]
        if name not in tables:
            raise InputError(f"page: no table {name!r}, only {', '.join(tables)}")
        return f"<!-- {name} -->\n{tables[name]}\n<!-- end -->"

    return _SPAN.sub(filled, page)


@functools.cache
def tables_of(folder: Path) -> Tables:
    """Return the tables of a reproduction's folder as Markdown, by name."""
    one = run_tables.tables(Run.load(folder, RESULTS)) if (folder / RESULTS).is_file() else {}
    if (folder / Summary.file).is_file():
        runs = sorted(map(Run.load, folder.glob("seed*/")), key=lambda run: run.recipe.seed)
        return seed_tables.tables(runs, Summary.load(folder)) | {f"run {name}": one[name] for name in one}
    if one:
        return one
    path = folder / "result.json"
    return load_experiment(str(folder)).tabulate(read_json(path), str(path))


def fill_folder(folder: Path) -> str:
    """Return the page of a reproduction with its tables filled in."""
    return fill((folder / "README.md").read_text(encoding="utf-8"), tables_of(folder))


def main(folders: Sequence[str]) -> None:
    """Fill the tables of the folders' pages."""
    for folder in map(Path, folders):
        write_bytes(folder / "README.md", fill_folder(folder).encode())


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
