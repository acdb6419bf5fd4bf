"""Documentation of the fields of dataclasses and models, read from the comments in their source.

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
    """A field declaration in the source of a class."""

    type: str
    default: str  # empty where there is none
    comment: str  # on the lines of the field, without the `#`; empty where there is none


def written_fields(owner: type) -> Mapping[str, Written]:
    """Return the annotated fields of a class of flcav in order of definition, inherited fields first."""
    fields: dict[str, Written] = {}
    for base in reversed(owner.__mro__):
        if base.__module__.partition(".")[0] == "flcav":
            fields |= _declared_fields(base)
    return fields


def document_fields(owner: type) -> None:
    """Append the fields of a dataclass or model and their comments to its docstring, for `help()`.

    A class whose source is not available keeps its docstring.
    """
    docstring = owner.__doc__ or ""
    try:
        written = {} if f"\n{HEADING}\n" in docstring else written_fields(owner)
    except OSError:
        return
    names = [name for name in written if not name.startswith("_") and not written[name].type.startswith("ClassVar")]
    if not names:
        return
    lines = [f"    {name}: {written[name].type}" for name in names]
    width = min(max(map(len, lines)), MOST_CHARACTERS)
    shown = (f"{line:{width}}  # {written[name].comment}".rstrip(" #") for name, line in zip(names, lines))
    owner.__doc__ = "\n".join([inspect.cleandoc(docstring), "", HEADING, *shown])


def _declared_fields(owner: type) -> dict[str, Written]:
    source = textwrap.dedent(inspect.getsource(owner))
    # The syntax tree has no comments: they come from the tokens, and are matched to fields by line.
    tokens = [*tokenize.generate_tokens(io.StringIO(source).readline)]
    lines = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    fields = {}
    body = ast.parse(source).body[0].body  # type: ignore[attr-defined]
    code = {token.start[0] for token in tokens if token.type not in BLANK}
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            after = node.end_lineno or node.lineno
            while after + 1 in lines and after + 1 not in code:  # comment lines below the field
                after += 1
            around = range(node.lineno, after + 1)
            comment = " ".join(lines[line] for line in around if line in lines)
            default = ast.unparse(node.value) if node.value else ""
            fields[node.target.id] = Written(ast.unparse(node.annotation), default, comment)
    return fields


def lazy_names(package: str, places: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` for `package`; `places` maps each public name to the module that defines it.

    The returned `__getattr__` raises AttributeError for any other name.
    """

    def __getattr__(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        submodule = places[name] == package
        value = import_module(f"{package}.{name}") if submodule else getattr(import_module(places[name]), name)
        if isinstance(value, type) and (is_dataclass(value) or hasattr(value, "model_fields")):
            document_fields(value)
        setattr(sys.modules[package], name, value)  # so that it is looked up once
        return value

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *places})

    return __getattr__, __dir__
