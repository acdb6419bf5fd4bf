"""The Sphinx directive `public-names PACKAGE [KIND]`: a table of a package's public names, then each in full.

KIND is `functions`, `records` (all classes) or `constants`; without it names of all kinds are shown, in this order.

Docstrings are plain text with `code` and doctest examples; they are escaped, so that nothing in them is taken for
markup. Fields of records and models are listed with their types, defaults and the comments beside them.
"""

import ast
import dataclasses
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

from docutils import nodes
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from flcav.interface.fields import HEADING, written_fields

KINDS = ("functions", "records", "constants")
WHOLE = "flcav"  # the package whose names are not said again of the others


class PublicNames(SphinxDirective):
    """Documents `__all__` of the package that is its first argument, without what `flcav` itself has."""

    required_arguments = 1
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the table of names, and the documentation of each, by autodoc."""
        package, *kinds = self.arguments
        names = [name for kind in kinds or KINDS for name in public_names(package) if kind_of(package, name) == kind]
        rst = "\n".join((table_of(package, names), *(autodoc_of(package, name) for name in names)))
        return self.parse_text_to_nodes(f"```{{eval-rst}}\n{rst}\n```")


def public_names(package: str) -> tuple[str, ...]:
    """Return the names that a package gives, in its own order, without the modules among them."""
    module = importlib.import_module(package)
    whole = () if package == WHOLE else public_names(WHOLE)
    return tuple(name for name in module.__all__ if name not in whole and not inspect.ismodule(getattr(module, name)))


def kind_of(package: str, name: str) -> str:
    """Return which of `KINDS` a public name is."""
    value = getattr(importlib.import_module(package), name)
    return "records" if isinstance(value, type) else "functions" if callable(value) else "constants"


def table_of(package: str, names: Sequence[str]) -> str:
    """Return a table of functions and classes: links, and the first sentence of each docstring."""
    rows = [
        f"   * - :py:obj:`{name} <{package}.{name}>`\n     - {escaped(first_sentence(package, name))}"
        for name in names
        if kind_of(package, name) != "constants"
    ]
    return "\n".join((".. list-table::\n   :widths: 20 80\n", *rows, "")) if rows else ""


def first_sentence(package: str, name: str) -> str:
    """Return the first sentence of a public name's docstring."""
    said = inspect.getdoc(getattr(importlib.import_module(package), name)) or ""
    return re.split(r"(?<=[\w)`]\.) (?=[A-Z])", " ".join(said.split("\n\n")[0].split()))[0]


def autodoc_of(package: str, name: str) -> str:
    """Return the autodoc directive of a public name."""
    value = getattr(importlib.import_module(package), name)
    if isinstance(value, type):
        return f".. autoclass:: {package}.{name}\n   :members:\n   :exclude-members: model_config\n"
    if callable(value):
        return f".. autofunction:: {package}.{name}\n"
    listed = ", ".join(f"``{each}``" for each in value)
    return f".. py:data:: {package}.{name}\n\n   {'By name' if isinstance(value, dict) else 'Names'}: {listed}\n"


def describe(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Rewrite a docstring as reStructuredText, a class's fields below it."""
    said, _, _ = "\n".join(lines).partition(f"\n\n{HEADING}\n")  # they are listed below
    paragraphs = said.strip().split("\n\n")
    text = "\n\n".join(as_rst(each) for each in paragraphs)
    if what == "class" and has_fields(value):
        text += "\n\n" + "\n".join(field_list(value))
    lines[:] = [*text.split("\n"), ""]


def as_written(app: Sphinx, what: str, name: str, value: Any, *said: Any) -> tuple[str, str] | None:
    """Return the signature of a function as its source writes it, with the names of types that are there.

    None is given of a class whose fields are listed, and of a protocol, which nobody calls.
    """
    if what == "class" and (has_fields(value) or getattr(value, "_is_protocol", False)):
        return "", ""
    if what not in ("function", "method"):
        return None
    node = ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]
    assert isinstance(node, ast.FunctionDef)
    arguments = node.args
    if what == "method" and arguments.args and arguments.args[0].arg in ("self", "cls"):
        del arguments.args[0]
    returns = ast.unparse(node.returns).strip("'") if node.returns else ""  # 'Town' within the class itself
    return f"({ast.unparse(arguments)})", returns


def as_rst(paragraph: str) -> str:
    """Return a paragraph of a docstring as reStructuredText: examples and lists as they are, `Args:` as a field list.

    >>> as_rst("Return `a`s of *args, see x_.")
    'Return ``a``\\\\ s of \\\\*args, see x\\\\_.'
    >>> as_rst("Args:\\n    seed: seed of the draws.")
    ':param seed: seed of the draws.'
    """
    first = paragraph.lstrip()
    if first.startswith(">>>"):
        return paragraph
    if first.startswith("Args:\n"):
        listed = re.findall(r"^(\w+): (.*(?:\n +.*)*)", textwrap.dedent(paragraph.partition("\n")[2]), re.M)
        return "\n".join(f":param {name}: {escaped(' '.join(said.split()))}" for name, said in listed)
    if paragraph.startswith(" ") or (not first.startswith("- ") and re.search(r"\n +", paragraph)):
        return "\n".join(f"| {escaped(line)}" for line in paragraph.split("\n"))
    return escaped(paragraph)


def escaped(text: str) -> str:
    """Return plain text with `code` as reStructuredText."""
    parts = re.split(r"`+([^`\n]+(?:\n[^`\n]+)?)`+", text)
    found = []
    for i, part in enumerate(parts):
        if i % 2:
            after = parts[i + 1][:1]
            found.append(f"``{part}``" + ("\\ " if after.isalnum() else ""))
        else:
            found.append(re.sub(r"([\\*|])|(?<=\w)_(?!\w)", lambda hit: "\\" + hit[0], part))
    return "".join(found)


def has_fields(owner: type) -> bool:
    """Return whether a class is a record or a model."""
    return dataclasses.is_dataclass(owner) or issubclass(owner, BaseModel)


def field_list(owner: Any) -> Iterator[str]:
    """Yield a list of the fields of a record or a model."""
    if dataclasses.is_dataclass(owner):
        names: Sequence[str] = [field.name for field in dataclasses.fields(owner) if not field.name.startswith("_")]
    else:
        names = [*owner.model_fields]
    written = written_fields(owner)
    if names:
        yield ".. rubric:: Fields\n"
    for name in names:
        field = written[name]
        default = f" = {field.default}" if field.default else ""
        yield f"- ``{name}: {field.type}{default}``" + (f" – {escaped(field.comment)}" if field.comment else "")


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directive to Sphinx."""
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", describe)
    app.connect("autodoc-process-signature", as_written)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
