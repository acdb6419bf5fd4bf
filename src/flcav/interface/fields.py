"""The fields of a record or of a model as its source writes them, with the comment beside each.

Lazy imports: module attributes that are imported on first access (PEP 562).
"""

import ast
import inspect
import io
import sys
import textwrap
import tokenize
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from importlib import import_module
from typing import Any

HEADING = "Fields:"
MOST_CHARACTERS = 60  # before the comments, which stand in a column
BLANK = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}


@dataclass(frozen=True)
class Written:
    """A field as it is written in a class."""

    type: str
    default: str  # empty where there is none
    comment: str  # on the field's own lines, without the sign; empty where there is none


def written_fields(owner: type) -> Mapping[str, Written]:
    """Return the annotated fields of a class of flcav, those it inherits included, in order."""
    found: dict[str, Written] = {}
    for each in reversed(owner.__mro__):
        if each.__module__.partition(".")[0] == "flcav":
            found |= _own_fields(each)
    return found


def document_fields(owner: type) -> None:
    """Append the fields of a record or a model to its docstring, each with the comment beside it, for `help()`.

    A class whose source is not at hand keeps its docstring.
    """
    said = owner.__doc__ or ""
    try:
        written = {} if f"\n{HEADING}\n" in said else written_fields(owner)
    except OSError:
        return
    names = [name for name in written if not name.startswith("_") and not written[name].type.startswith("ClassVar")]
    if not names:
        return
    lines = [f"    {name}: {written[name].type}" for name in names]
    width = min(max(map(len, lines)), MOST_CHARACTERS)
    shown = (f"{line:{width}}  # {written[name].comment}".rstrip(" #") for name, line in zip(names, lines))
    owner.__doc__ = "\n".join([inspect.cleandoc(said), "", HEADING, *shown])


def _own_fields(owner: type) -> dict[str, Written]:
    source = textwrap.dedent(inspect.getsource(owner))
    read = [*tokenize.generate_tokens(io.StringIO(source).readline)]
    lines = {token.start[0]: token.string.lstrip("# ") for token in read if token.type == tokenize.COMMENT}
    found = {}
    body = ast.parse(source).body[0].body  # type: ignore[attr-defined]
    code = {token.start[0] for token in read if token.type not in BLANK}
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            after = node.end_lineno or node.lineno
            while after + 1 in lines and after + 1 not in code:  # comments below the field, on lines of their own
                after += 1
            around = range(node.lineno, after + 1)
            comment = " ".join(lines[line] for line in around if line in lines)
            default = ast.unparse(node.value) if node.value else ""
            found[node.target.id] = Written(ast.unparse(node.annotation), default, comment)
    return found


def lazy_names(package: str, places: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` for `package`; `places` maps each public name to the module that defines it.

    The returned `__getattr__` raises AttributeError for any other name.
    """

    def __getattr__(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        submodule = places[name] == package
        found = import_module(f"{package}.{name}") if submodule else getattr(import_module(places[name]), name)
        if isinstance(found, type) and (is_dataclass(found) or hasattr(found, "model_fields")):
            document_fields(found)
        setattr(sys.modules[package], name, found)  # so that it is looked up once
        return found

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *places})

    return __getattr__, __dir__
