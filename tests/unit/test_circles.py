"""No two files import each other, whether directly or through others, for types alone or to run."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from statements import list_imports

import flcav


def imports(folder: Path) -> dict[str, set[str]]:
    """Return which modules each module of a package imports, anywhere in it; a package's own `__init__` is left out."""
    paths = {}
    for path in folder.rglob("*.py"):
        if path.name != "__init__.py":
            paths[".".join((folder.name, *path.relative_to(folder).with_suffix("").parts))] = path
    found: dict[str, set[str]] = {}
    for name, path in paths.items():
        named: set[tuple[str, str]] = set()
        for node in list_imports(ast.parse(path.read_text(encoding="utf-8"))):
            named |= {(node.module or "", alias.name) for alias in node.names}
        found[name] = {place for module, own in named for place in (module, f"{module}.{own}") if place in paths}
    return found


def test_files_do_not_import_each_other_in_a_circle() -> None:
    found = imports(Path(flcav.__file__).parent)
    assert len(found) > 200
    TopologicalSorter(found).prepare()


def test_a_circle_through_a_third_file_for_types_alone_is_seen(tmp_path: Path) -> None:
    files = {
        "a": "from toy import b",
        "b": "def late():\n    from toy.c import C",
        "c": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from toy.a import A",
    }
    (tmp_path / "toy").mkdir()
    for name, text in files.items():
        (tmp_path / "toy" / f"{name}.py").write_text(text)
    with pytest.raises(CycleError):
        TopologicalSorter(imports(tmp_path / "toy")).prepare()
