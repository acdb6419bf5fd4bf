"""The fields of a record or of a model as its source writes them, with the comment beside each."""

import ast
import inspect
import io
import textwrap
import tokenize
from collections.abc import Mapping
from dataclasses import dataclass


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


def _own_fields(owner: type) -> dict[str, Written]:
    source = textwrap.dedent(inspect.getsource(owner))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    lines = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    found = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            around = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            comment = " ".join(lines[line] for line in around if line in lines)
            default = ast.unparse(node.value) if node.value else ""
            found[node.target.id] = Written(ast.unparse(node.annotation), default, comment)
    return found
