"""Hash of the code that a step's value depends on: the definitions reachable from its function by static analysis.

Only syntax trees are read; nothing is imported. A definition is what one statement at the top of a module binds: a
function, a class, a constant. It reaches the definitions that it mentions, through imports at the top of its module or
within itself, and through packages that re-export names. Formatting, comments and docstrings do not count, nor do
imports for type checkers and blocks under `__name__ == "__main__"`.

A string `module:NAME` counts as a mention of that name, and so do the re-exported names of a module's `__getattr__`
(see `_lazy`). Not covered are other names looked up by strings, data files, and other packages, whose versions are in
`flcav.pipeline.provenance`.
"""

import ast
import contextlib
import functools
import gc
import hashlib
import importlib.util
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any

import flcav
from flcav.config import Config

Place = tuple[str, str]  # module, name that a statement at its top binds; WHOLE: all of them
Target = tuple[str, str]  # module, dotted name in it, "" for the module itself
WHOLE = "*"
NAMED = re.compile(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)")  # a definition, as named in tables and recipes
PACKAGES = {"flcav": Path(flcav.__file__).parent}


class Sources:
    """Sources of `packages` (name -> folder), and of single modules beside them, each read once."""

    def __init__(self, packages: Mapping[str, Path] = PACKAGES) -> None:
        self._packages = packages
        self._modules: dict[str, _Module | None] = {}
        self._hashes: dict[frozenset[Place], dict[str, str]] = {}
        self._reaches: dict[_Statement, tuple[list[Place], list[str]]] = {}

    def hashes(self, starts: Iterable[Place]) -> dict[str, str]:
        """Return, by module, a hash of the definitions in it that are reachable from `starts`."""
        key = frozenset(starts)
        if key not in self._hashes:
            with _without_collector():
                reached = self._reached(key)
            self._hashes[key] = {
                name: hashlib.sha256("\n".join(texts).encode()).hexdigest()[:12]
                for name, texts in sorted(reached.items())
                if texts
            }
        return self._hashes[key]

    def _reached(self, starts: Iterable[Place]) -> dict[str, list[str]]:
        """Return, by module, the text of the statements reachable from `starts`, in the order of the source."""
        found: dict[str, set[_Statement]] = {}
        others: dict[str, set[str]] = {}
        left, seen = list(starts), set(starts)
        while left:
            name, wanted = left.pop()
            module = self._module(name)
            if module is None:
                continue
            if package := name.rpartition(".")[0]:
                left += [(package, "")] if (package, "") not in seen else []  # a package runs before its modules
                seen.add((package, ""))
            for statement in {*module.always, *module.binding(wanted)} - found.setdefault(name, set()):
                found[name].add(statement)
                places, foreign = self._reach(statement)
                others.setdefault(name, set()).update(foreign)
                left += [place for place in places if place not in seen]
                seen.update(places)
        return {
            name: [s.text for s in sorted(statements, key=lambda s: s.line)] + sorted(others.get(name, ()))
            for name, statements in found.items()
        }

    def _reach(self, statement: "_Statement") -> tuple[list[Place], list[str]]:
        """Return the definitions that a statement mentions, and what it mentions outside these sources."""
        if statement not in self._reaches:
            places: dict[Place, None] = {}
            foreign = []
            for target, as_written in statement.mentions:
                found = list(self._resolve(target))
                if as_written and not found:
                    foreign.append(f"{as_written}: {target}")
                places.update(dict.fromkeys(found))
            self._reaches[statement] = [*places], foreign
        return self._reaches[statement]

    def _resolve(self, target: Target) -> Iterator[Place]:
        """Yield the definitions that an import or mention names; none where they are outside these sources."""
        name, path = target
        while (module := self._module(name)) is not None:
            part, _, beyond = path.partition(".")
            inner = f"{name}.{part}"
            if not part:
                yield name, WHOLE
            elif part in module.defined:
                yield name, part
            elif part in module.imports and module.imports[part] != (name, part):
                origin, first = module.imports[part]
                yield from self._resolve((origin, f"{first}.{beyond}".strip(".")))
            elif self._module(inner) is not None:
                name, path = inner, beyond
                continue
            elif part in module.lazy:
                yield from self._resolve((module.lazy[part], path))
            elif not part.startswith("__"):
                yield name, WHOLE
            return

    def _module(self, name: str) -> "_Module | None":
        if name not in self._modules:
            path = self._file(name)
            self._modules[name] = None if path is None else _read(name, path.name == "__init__.py", path.read_text())
        return self._modules[name]

    def _file(self, name: str) -> Path | None:
        top, *parts = name.split(".")
        if top in self._packages:
            folder = self._packages[top].joinpath(*parts)
            return next((path for path in (folder / "__init__.py", folder.with_suffix(".py")) if path.is_file()), None)
        loaded = getattr(sys.modules.get(name), "__file__", None) or ""
        if not loaded and not parts and name != "__main__" and (spec := importlib.util.find_spec(name)) is not None:
            loaded = spec.origin or ""
        foreign = top in sys.stdlib_module_names - {"__main__"} or "site-packages" in loaded
        return None if foreign or not loaded.endswith(".py") else Path(loaded)


@contextlib.contextmanager
def _without_collector() -> Iterator[None]:
    """Pause the collector of cyclic garbage: syntax trees are all kept, and it takes as long as reading them.

    Afterwards they are in its oldest generation, as if it had looked at them.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            if not gc.get_freeze_count():  # what others froze stays frozen
                gc.freeze()
                gc.unfreeze()
            gc.enable()


def find_definitions(value: Any) -> Iterator[Place]:
    """Yield the definitions of all functions and classes in `value`, its fields, items and bound arguments included.

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
        yield from find_definitions(type(value))
        if isinstance(value, Config):
            yield from find_definitions([getattr(value, name) for name in type(value).model_fields])
        elif is_dataclass(value):
            yield from find_definitions([getattr(value, each.name) for each in fields(value) if each.compare])


def package_hash() -> str:
    """Return a hash of all source files of flcav, to tell whether two machines run the same code."""
    hashed = hashlib.sha256()
    for name, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            hashed.update(f"{name}/{path.relative_to(folder).as_posix()}\n".encode() + path.read_bytes())
    return hashed.hexdigest()[:16]


class _Statement:
    """A statement at the top level of a module."""

    def __init__(self, module: "_Module", node: ast.stmt) -> None:
        self.module, self.node, self.line = module, node, node.lineno

    @functools.cached_property
    def text(self) -> str:
        return ast.unparse(self.node)

    @functools.cached_property
    def mentions(self) -> list[tuple[Target, str]]:
        """The definitions that it mentions, in its module and others, each with the name used here ("" without)."""
        names = _Names(self.module.name, self.module.package)
        names.visit(self.node)
        found = [((module, ""), module) for module in names.star] + [(target, "") for target in names.named]
        for root, rest in sorted(names.found):
            for imports in (names.imports, self.module.imports):
                if root in imports:
                    module, first = imports[root]
                    found.append(((module, f"{first}.{rest}".strip(".")), root))
            if root in self.module.defined:
                found.append(((self.module.name, root), root))
        return found


class _Module:
    """The syntax of a module: imports, definitions, and statements that always run."""

    def __init__(self, name: str, package: bool) -> None:
        self.name, self.package = name, package
        self.imports: dict[str, Target] = {}  # by bound name
        self.defined: dict[str, list[_Statement]] = {}
        self.always: list[_Statement] = []  # statements that run with any import
        self.lazy: dict[str, str] = {}

    def binding(self, name: str) -> list[_Statement]:
        """Return the statements that bind `name`."""
        if name == WHOLE:
            return [statement for statements in self.defined.values() for statement in statements]
        return self.defined.get(name, [])


class _Names(ast.NodeVisitor):
    """Visitor that collects the names in a syntax tree, each with its attributes, and the imports."""

    def __init__(self, module: str, package: bool) -> None:
        self._module, self._package = module, package
        self.found: set[tuple[str, str]] = set()
        self.imports: dict[str, Target] = {}
        self.star: list[str] = []
        self.named: list[Target] = []

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, str) and (found := NAMED.fullmatch(node.value)):
            self.named.append((found[1], found[2]))

    def visit_Name(self, node: ast.Name) -> None:
        self.found.add((node.id, ""))

    def visit_Attribute(self, node: ast.Attribute) -> None:
        parts: list[str] = []
        inner: ast.expr = node
        while isinstance(inner, ast.Attribute):
            parts.insert(0, inner.attr)
            inner = inner.value
        if isinstance(inner, ast.Name):
            self.found.add((inner.id, ".".join(parts)))
        else:
            self.visit(inner)

    def visit_If(self, node: ast.If) -> None:
        for part in [*([] if _left_out(node.test) else node.body), *node.orelse]:
            self.visit(part)
        self.visit(node.test)

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            whole = alias.name if alias.asname else alias.name.partition(".")[0]
            self.imports[alias.asname or whole] = whole, ""

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        origin = node.module or ""
        if node.level:
            up = node.level - self._package
            above = self._module.rsplit(".", up)[0] if up else self._module
            origin = f"{above}.{origin}".rstrip(".")
        for alias in node.names:
            if alias.name == "*":
                self.star.append(origin)
            else:
                self.imports[alias.asname or alias.name] = origin, alias.name


@functools.lru_cache(maxsize=2048)
def _read(name: str, package: bool, text: str) -> _Module:
    tree = ast.parse(text)
    _undocument(tree)
    module = _Module(name, package)
    for node in tree.body:
        if isinstance(node, ast.If) and _left_out(node.test) and not node.orelse:
            continue
        statement = _Statement(module, node)
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = _Names(name, package)
            names.visit(node)
            module.imports |= names.imports
            module.always += [statement] if names.star else []
        elif bound := list(_bound(node)):
            for each in bound:
                module.defined.setdefault(each, []).append(statement)
        else:
            module.always.append(statement)
            inner = _Names(name, package)
            inner.visit(node)
            module.imports |= inner.imports
            for part in ast.walk(node):
                for each in _bound(part):
                    module.defined.setdefault(each, []).append(statement)
    if "__getattr__" in module.defined:
        module.lazy = _lazy(tree)
    return module


def _undocument(node: ast.AST) -> None:
    """Remove the docstrings within a statement: strings that are statements, wherever those stand."""
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        inner = getattr(node, field, None)
        if isinstance(inner, list):  # those of an expression are none
            inner[:] = [each for each in inner if not _is_docstring(each)]
            for each in inner:
                _undocument(each)
    if isinstance(node, ast.stmt) and getattr(node, "body", None) == []:
        node.body = [ast.Pass()]  # pyright: ignore[reportAttributeAccessIssue]


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _bound(node: ast.AST) -> Iterator[str]:
    """Yield the names that a definition or an assignment binds, or changes in place: `NAMES["x"] = 1`."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        yield node.name
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
        for target in targets:
            while isinstance(target, ast.Attribute | ast.Subscript | ast.Starred):
                target = target.value
            for part in target.elts if isinstance(target, ast.Tuple | ast.List) else [target]:
                if isinstance(part, ast.Name):
                    yield part.id


def _left_out(test: ast.expr) -> bool:
    """Return whether a block under this condition is only for type checkers, or for running the module as a program."""
    text = ast.unparse(test)
    return text in ("TYPE_CHECKING", "typing.TYPE_CHECKING") or text == "__name__ == '__main__'"


def _lazy(tree: ast.Module) -> dict[str, str]:
    """Return the modules of the names that a `__getattr__` re-exports, from dictionaries of strings at the top."""
    pairs = (
        (k, v)
        for node in tree.body
        for each in ast.walk(node)
        if isinstance(each, ast.Dict)
        for k, v in zip(each.keys, each.values, strict=True)
    )
    return {
        key.value: value.value
        for key, value in pairs
        if isinstance(key, ast.Constant) and isinstance(value, ast.Constant)
        if isinstance(key.value, str) and isinstance(value.value, str)
    }
