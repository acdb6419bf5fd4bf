"""Hash of the code that a step's value depends on: the definitions reachable from its function by static analysis.

Only syntax trees are read; nothing is imported. A definition is what one top-level statement of a module binds: a
function, a class, a constant. It reaches the definitions that it mentions: names of its module or imported anywhere in
it, also through packages that re-export them (`PLACES` of lazy ones), and strings `module:NAME`. Layout, comments,
docstrings, imports for type checkers and blocks under `__name__ == "__main__"` do not count. Not covered are other
names looked up by strings, data files, and third-party packages, whose versions are in `flcav.runs.provenance`.
"""

import ast
import functools
import importlib.util
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any

import flcav
from flcav.config import Config
from flcav.machine.threads import pause_collector
from flcav.runs.engine.step import digest

Place = tuple[str, str]  # module, name bound at its top; WHOLE: all of them, "": statements that any import runs
Target = tuple[str, str]  # module, dotted name in it; "": the module itself
WHOLE = "*"
NAMED = re.compile(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)")  # a definition, as named in tables and recipes
UNCOUNTED = ("TYPE_CHECKING", "typing.TYPE_CHECKING", "__name__ == '__main__'")  # conditions of blocks
PACKAGES = {"flcav": Path(flcav.__file__).parent}


class Sources:
    """Source code of `packages` (name -> folder) and of single modules outside them; a module is read once."""

    def __init__(self, packages: Mapping[str, Path] = PACKAGES) -> None:
        self._packages = packages
        self._module = functools.cache(self._read)
        self._reach = functools.cache(self._resolve_mentions)
        self._of_starts = functools.cache(self._hash_reached)  # steps of one kind start at the same definitions

    def hashes(self, starts: Iterable[Place]) -> dict[str, str]:
        """Return the hash of the definitions reachable from `starts`, by module."""
        return self._of_starts(frozenset(starts))

    def lack(self, modules: Iterable[str]) -> bool:
        """Return whether one of the modules no longer exists: it was renamed, or its content has moved to another."""
        return any(self._module(name) is None for name in modules)

    @pause_collector()  # syntax trees are all kept
    def _hash_reached(self, starts: frozenset[Place]) -> dict[str, str]:
        reached: dict[str, set[ast.stmt]] = defaultdict(set)
        left = [*starts]
        seen = set[Place]()
        while left:
            place = name, wanted = left.pop()
            if place in seen or (module := self._module(name)) is None:
                continue
            seen.add(place)
            left += [(name, ""), (name.rpartition(".")[0], "")]  # a package runs before its modules
            for bound in module.defined if wanted == WHOLE else [wanted]:
                for statement in module.defined.get(bound, ()):
                    reached[name].add(statement)
                    left += self._reach(name, statement)
        return {name: self._digest(name, statements) for name, statements in sorted(reached.items())}

    def _digest(self, name: str, statements: Iterable[ast.stmt]) -> str:
        """Return the hash of statements of a module, and of what they import from outside these sources."""
        ordered = sorted(statements, key=lambda node: node.lineno)
        mentioned = {place for node in ordered for place in self._reach(name, node)}
        return digest(
            [[_unparse(node) for node in ordered], sorted(p for p in mentioned if self._module(p[0]) is None)]
        )

    def _resolve_mentions(self, name: str, statement: ast.stmt) -> set[Place]:
        """Return the definitions that a statement of the module `name` mentions."""
        module, targets = self._module(name), list[Target]()
        assert module is not None
        for mention in _list_mentions(statement):
            if found := NAMED.fullmatch(mention):
                targets.append((found[1], found[2]))
                continue
            root, _, rest = mention.partition(".")
            targets += [(origin, f"{first}.{rest}".strip(".")) for origin, first in module.imports.get(root, ())]
            targets += [(name, root)] if root in module.defined else []
        return {place for target in targets for place in self._resolve(*target)}

    def _resolve(self, name: str, path: str) -> Iterator[Place]:
        """Yield the definitions that a target names; the target itself if it is outside these sources."""
        part, _, rest = path.partition(".")
        if (module := self._module(name)) is None:
            yield name, path
        elif part in module.defined:
            yield name, part or WHOLE
        elif origins := [target for target in module.imports.get(part, ()) if target != (name, part)]:
            for origin, first in origins:
                yield from self._resolve(origin, f"{first}.{rest}".strip("."))
        elif self._module(f"{name}.{part}") is not None:
            yield from self._resolve(f"{name}.{part}", rest)
        elif part in module.places:
            yield from self._resolve(module.places[part], path)
        elif not part.startswith("__"):
            yield name, WHOLE

    def _read(self, name: str) -> "_Module | None":
        top, *parts = name.split(".")
        if top in self._packages:
            folder = self._packages[top].joinpath(*parts)
            path = next((path for path in (folder / "__init__.py", folder.with_suffix(".py")) if path.is_file()), None)
        else:
            path = _find_users(name)
        package = name if path is not None and path.name == "__init__.py" else name.rpartition(".")[0]
        return None if path is None else _parse(package, path.read_text())


def _find_users(name: str) -> Path | None:
    """Return the file of a user's module; None for one of Python or of an installed package."""
    loaded = getattr(sys.modules.get(name), "__file__", None) or ""
    if not loaded and name.isidentifier() and name != "__main__":
        loaded = getattr(importlib.util.find_spec(name), "origin", None) or ""
    known = name.partition(".")[0] in sys.stdlib_module_names - {"__main__"} or "site-packages" in loaded
    return None if known or not loaded.endswith(".py") else Path(loaded)


def find_definitions(value: Any) -> Iterator[Place]:
    """Yield the definitions of all functions and classes in `value`, including its fields, items and bound arguments.

    Keys of mappings count: `module:NAME` may be one, with settings. Fields of a dataclass with `compare=False` are left
    out.
    """
    if isinstance(value, MethodType):
        yield from find_definitions(value.__self__)
    elif isinstance(value, functools.partial):
        yield from find_definitions((value.func, value.args, value.keywords))
    elif isinstance(value, FunctionType | type):
        name = value.__qualname__.partition(".")[0]
        yield value.__module__, WHOLE if name == "<lambda>" else name
    elif isinstance(value, str):
        if found := NAMED.fullmatch(value):
            yield found[1], found[2]
    elif isinstance(value, Mapping):
        yield from find_definitions((*value, *value.values()))
    elif isinstance(value, list | tuple | set | frozenset):
        for item in value:
            yield from find_definitions(item)
    else:
        counted = [field.name for field in fields(value) if field.compare] if is_dataclass(value) else []
        names = type(value).model_fields if isinstance(value, Config) else counted
        yield from find_definitions([type(value), *(getattr(value, name) for name in names)])


def package_hash() -> str:
    """Return the hash of all source files of flcav, by which machines check that they run the same code."""
    folder = PACKAGES["flcav"]
    return digest({path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*.py")})


class _Module(ast.NodeTransformer):
    """The syntax of a module in `package`, without docstrings, `pass` and `UNCOUNTED` blocks."""

    def __init__(self, package: str, text: str) -> None:
        self._package = package
        self.imports: dict[str, list[Target]] = {}  # anywhere, by bound name; "": of all names of a module
        self.defined: dict[str, list[ast.stmt]] = {"": []}  # by bound name; "": statements that any import runs
        self.places: Mapping[str, str] = {}  # modules of the names that a lazy package re-exports
        for node in self.visit(ast.parse(text)).body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                bound = {""} & _list_mentions(node)
            else:
                bound = _bound(node) or {"", *(name for part in ast.walk(node) for name in _bound(part))}
            for name in bound:
                self.defined.setdefault(name, []).append(node)
            if bound == {"PLACES"} and isinstance(node, ast.Assign):
                self.places = ast.literal_eval(node.value)

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        return None if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str) else node

    def visit_Pass(self, node: ast.Pass) -> None:
        return None

    def visit_If(self, node: ast.If) -> Any:
        self.generic_visit(node)
        return node.orelse if ast.unparse(node.test) in UNCOUNTED else node

    def visit_Import(self, node: ast.Import) -> ast.Import:
        for alias in node.names:
            whole = alias.name if alias.asname else alias.name.partition(".")[0]
            self.imports.setdefault(alias.asname or whole, []).append((whole, ""))
        return node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.ImportFrom:
        origin = importlib.util.resolve_name("." * node.level + (node.module or ""), self._package)
        for alias in node.names:
            name = alias.name.strip("*")
            self.imports.setdefault(alias.asname or name, []).append((origin, name))
        return node

    def generic_visit(self, node: ast.AST) -> ast.AST:
        return node if isinstance(node, ast.expr) else super().generic_visit(node)


_parse = functools.lru_cache(maxsize=2048)(_Module)


def _bound(node: ast.AST) -> set[str]:
    """Return the names that a definition or an assignment binds, or changes in place: `NAMES["x"] = 1`."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {node.name}
    if not isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
        return set()
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return {part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)}


@functools.lru_cache(maxsize=1 << 16)
def _list_mentions(node: ast.AST) -> set[str]:
    """Return the names in a statement, with their attributes, strings `module:NAME`, and "" for `import *`."""
    mentions: set[str] = set()
    left = [node]
    while left:
        part, attributes = left.pop(), ""
        while isinstance(part, ast.Attribute):
            part, attributes = part.value, f".{part.attr}{attributes}"
        if isinstance(part, ast.Name):
            mentions.add(part.id + attributes)
        elif isinstance(part, ast.Constant) and isinstance(part.value, str) and NAMED.fullmatch(part.value):
            mentions.add(part.value)
        elif isinstance(part, ast.alias) and part.name == "*":
            mentions.add("")
        left += ast.iter_child_nodes(part)
    return mentions


_unparse = functools.lru_cache(maxsize=1 << 16)(ast.unparse)
