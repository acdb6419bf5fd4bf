"""The Python pages: every public name is on one of them, and a docstring becomes markup that says what it said."""

import dataclasses
import importlib
import inspect
import pydoc
import re
from collections.abc import Callable
from pathlib import Path

import pytest

import flcav

pytest.importorskip("sphinx", reason="sphinx is not installed: the extra 'docs'")
from docutils import nodes
from docutils.core import publish_doctree
from public_names import as_rst, kind_of, public_names

DOCS = Path(__file__).parents[2] / "docs"
PAGES = "".join((DOCS / name).read_text(encoding="utf-8") for name in ("api.md", "api-packages.md"))
DOCUMENTED = re.findall(r"^```\{public-names\} (\S+)(?: (\w+))?$", PAGES, re.M)
PACKAGES = sorted(path.parent.name for path in Path(flcav.__path__[0]).glob("*/__init__.py"))


def test_every_package_with_public_names_is_documented():
    texts = {name: (Path(flcav.__path__[0]) / name / "__init__.py").read_text(encoding="utf-8") for name in PACKAGES}
    giving = {f"flcav.{name}" for name, text in texts.items() if "__all__" in text}
    with_more = {package for package in giving if public_names(package)}
    assert {package for package, _ in DOCUMENTED} == {"flcav", *with_more}
    for package in with_more | {"flcav"}:
        kinds = {kind for documented, kind in DOCUMENTED if documented == package}
        assert kinds == {""} or kinds >= {kind_of(package, name) for name in public_names(package)}


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Return `a`s of *args, see x_.", "Return as of *args, see x_."),
        (
            "wireless = samples * sample + |k|;\nwireline = model",
            "wireless = samples * sample + |k|;\nwireline = model",
        ),
        ("Rows:\n    one\n    two", "Rows:\n    one\n    two"),
    ],
)
def test_a_docstring_is_shown_as_it_was_written(text: str, shown: str):
    tree = publish_doctree(as_rst(text), settings_overrides={"report_level": 2, "halt_level": 2})
    assert " ".join(tree.astext().split()) == " ".join(shown.split())


def arguments(owner: Callable) -> list[str]:
    listed = (inspect.getdoc(owner) or "").partition("\nArgs:\n")[2].partition("\n\n")[0]
    return re.findall(r"^    (\w+): ", listed, re.M)


@pytest.mark.parametrize("package", sorted({package for package, _ in DOCUMENTED}))
def test_arguments_of_long_lists_are_documented_one_by_one(package: str):
    """The parameters of a function with four or more are those of its `Args:`; a shorter list may have none."""
    for name in public_names(package):
        owner = getattr(importlib.import_module(package), name)
        if not inspect.isfunction(owner):
            continue
        taken = [*inspect.signature(owner).parameters]
        if len(taken) >= 4 or arguments(owner):
            assert arguments(owner) == taken, name


def test_arguments_are_shown_as_fields():
    text = "Args:\n    seed: of `a` for b_.\n    out: a folder,\n        new."
    tree = publish_doctree(as_rst(text), settings_overrides={"report_level": 2, "halt_level": 2})
    fields = [[each.astext() for each in field.children] for field in tree.findall(nodes.field)]
    assert fields == [["param seed", "of a for b_."], ["param out", "a folder, new."]]


def test_examples_are_left_alone():
    assert as_rst(">>> a_ * 2\n4") == ">>> a_ * 2\n4"


@pytest.mark.parametrize("name", sorted(name for name in flcav.__all__ if isinstance(getattr(flcav, name), type)))
def test_help_shows_the_fields_of_records_and_models(name: str):
    owner = getattr(flcav, name)
    getattr(importlib.import_module(flcav.PLACES[name]), name)  # a second face gives the same class
    fields = [field.name for field in dataclasses.fields(owner)] if dataclasses.is_dataclass(owner) else []
    fields += getattr(owner, "model_fields", ())
    shown = pydoc.plain(pydoc.render_doc(owner))
    for field in fields:
        assert len(re.findall(rf"^ \|      {field}: ", shown, re.M)) == 1, field
