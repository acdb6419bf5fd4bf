"""The statements of a module, without the expressions in them, which are many times as many nodes."""

import ast
from collections import deque
from collections.abc import Iterator

BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")


def list_imports(module: ast.Module) -> Iterator[ast.ImportFrom]:
    """Yield each `from … import …` of a module, also those within functions, breadth first."""
    waiting: deque[ast.AST] = deque((module,))
    while waiting:
        node = waiting.popleft()
        for name in BLOCKS:
            waiting.extend(getattr(node, name, ()))
        if isinstance(node, ast.ImportFrom):
            yield node
