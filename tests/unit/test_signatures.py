"""What one package of flcav takes from another says what it is: no `Any`, no `object` in signatures between packages.

The syntax tree is read: of every function and class that a module of another first-level folder imports, the public
parameters, returned values and fields. `ALLOWED` holds what is left, with a reason each, and may only shrink.
"""

import ast
import gc
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from statements import list_imports

import flcav

VAGUE = frozenset({"Any", "object"})

UNCHECKED = "whatever a user's file holds, a date of YAML too, before it is checked"
STEPS = "a step's function, arguments and JSON value: whatever the step is"
OWN = "what a user's module holds, of the protocol that was asked for"
ALLOWED: Mapping[str, str] = {
    "flcav.config:parse_config": UNCHECKED,
    "flcav.config:read_yaml": UNCHECKED,
    "flcav.config:shorten": UNCHECKED,
    "flcav.interface.fields:lazy_names": OWN,
    "flcav.runs.engine.run:run_steps": STEPS,
    "flcav.runs.engine.step:Step.arguments": STEPS,
    "flcav.runs.engine.step:Step.run": STEPS,
    "flcav.runs.engine.step:Work.result": STEPS,
}


@dataclass(frozen=True)
class Tree:
    """The modules of a package by dotted name."""

    modules: Mapping[str, ast.Module]

    @cached_property
    def root(self) -> str:
        """The package's name."""
        return min(self.modules, key=len)

    def folder(self, module: str) -> str:
        """Return the first-level folder, or module, that a module is in."""
        return module.split(".")[1] if "." in module else ""

    @cached_property
    def known(self) -> dict[str, dict[str, ast.stmt]]:
        """By module: the statement that defines or imports each name."""
        return {module: dict(names(tree)) for module, tree in self.modules.items()}

    def found(self, module: str, name: str) -> tuple[str, ast.stmt] | None:
        """Return where a name that `module` knows is defined, and its definition; None where that is elsewhere."""
        node = self.known.get(module, {}).get(name)
        if not isinstance(node, ast.ImportFrom):
            return node and (module, node)
        origin = next(alias.name for alias in node.names if (alias.asname or alias.name) == name)
        return self.found(node.module or "", origin)

    def crossings(self) -> Iterator[tuple[str, ast.stmt]]:
        """Yield the definitions that a module of another folder imports, or reaches through a module it imports."""
        for module, tree in self.modules.items():
            for node in list_imports(tree):
                if not node.module or not node.module.startswith(self.root):
                    continue
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    names = attributes(tree, alias.asname or alias.name) if whole in self.modules else (alias.name,)
                    for name in names:
                        found = self.found(whole if whole in self.modules else node.module, name)
                        if found and self.folder(found[0]) != self.folder(module):
                            yield found

    def vague(self, module: str, annotation: ast.AST | None) -> bool:
        """Return whether an annotation in `module` says `Any` or `object`, by itself or through an alias."""
        for node in ast.walk(annotation) if annotation else ():
            if (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and self.vague(module, parsed(node.value))
            ):
                return True
            if isinstance(node, ast.Attribute) and node.attr == "Any":
                return True
            if isinstance(node, ast.Name):
                if node.id in VAGUE:
                    return True
                where, alias = self.found(module, node.id) or (module, None)
                value = alias.value if isinstance(alias, ast.Assign) else None
                if not isinstance(value, ast.Call) and self.vague(where, value):
                    return True
        return False

    def offenders(self) -> set[str]:
        """Return "module:name" of each function, method or field that crosses folders without saying what it takes."""
        return {
            f"{module}:{name}"
            for module, definition in set(self.crossings())
            for name, annotations in signatures(definition)
            if any(self.vague(module, annotation) for annotation in annotations)
        }


def names(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Yield each name that is defined at the top of a module, or imported anywhere in it, with its statement."""
    for node in list_imports(tree):
        yield from ((alias.asname or alias.name, node) for alias in node.names)
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node
        if isinstance(node, ast.Assign):
            yield from ((target.id, node) for target in node.targets if isinstance(target, ast.Name))


def parsed(text: str) -> ast.AST | None:
    """Return an annotation that is written as text; None where it is a word of a Literal."""
    try:
        return ast.parse(text, mode="eval")
    except SyntaxError:
        return None


def attributes(tree: ast.Module, name: str) -> set[str]:
    """Return what a module reaches through the module it knows by `name`."""
    return {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == name
    }


def signatures(definition: ast.stmt) -> Iterator[tuple[str, Iterable[ast.expr | None]]]:
    """Yield what is public of a function or class: names with their annotations."""
    if isinstance(definition, ast.FunctionDef):
        yield definition.name, annotations(definition)
    if isinstance(definition, ast.ClassDef):
        for node in definition.body:
            if isinstance(node, ast.FunctionDef) and (not node.name.startswith("_") or node.name == "__init__"):
                yield f"{definition.name}.{node.name}", annotations(node)
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id[0] != "_":
                yield f"{definition.name}.{node.target.id}", (node.annotation,)


def annotations(function: ast.FunctionDef) -> list[ast.expr | None]:
    own = function.args
    taken = (*own.posonlyargs, *own.args, *own.kwonlyargs, *filter(None, (own.vararg, own.kwarg)))
    return [*(argument.annotation for argument in taken), function.returns]


def read(folder: Path) -> Tree:
    """Return the modules below the folder of a package."""
    modules = {}
    gc.disable()  # or the collector walks through the growing trees again and again, for most of the time
    try:
        for path in sorted(folder.rglob("*.py")):
            parts = [folder.name, *path.relative_to(folder).with_suffix("").parts]
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            modules[name] = ast.parse(path.read_text(encoding="utf-8"))
    finally:
        gc.enable()
    return Tree(modules)


def test_what_crosses_packages_says_what_it_is() -> None:
    found = read(Path(flcav.__file__).parent).offenders()
    assert sorted(found - set(ALLOWED)) == [], "give these a record, or the exact type"
    assert sorted(set(ALLOWED) - found) == [], "these are mended: take them off the list"


def test_the_check_sees_aliases_fields_methods_and_modules(tmp_path: Path) -> None:
    files = {
        "__init__": "",
        "low/__init__": "from pkg.low.deep import hidden",
        "low/deep": """
from typing import Any
Row = dict[str, Any]
class Kept:
    value: object
    _own: Any
    def told(self) -> "list[Row]": ...
    def exact(self, why: int) -> str: ...
    def _inner(self) -> Any: ...
def hidden(**rest: Any) -> int: ...
def through(rows: list[Row]) -> int: ...
def local(row: Any) -> int: ...
""",
        "low/near": "from pkg.low.deep import local",
        "high/user": "from pkg.low import deep, hidden\nfrom pkg.low.deep import Kept\ndeep.through([])",
    }
    for name, text in files.items():
        path = tmp_path / "pkg" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    deep = "pkg.low.deep"
    wanted = {f"{deep}:{name}" for name in ("Kept.value", "Kept.told", "hidden", "through")}
    assert read(tmp_path / "pkg").offenders() == wanted
