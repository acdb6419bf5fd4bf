"""Plug-ins: tasks, strategies, formats and study charts of users, named `module:NAME` in commands and recipes."""

import importlib
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from flcav.config import InputError
from flcav.interface.wording import suggest

Wanted = TypeVar("Wanted")

PLACE = re.compile(r"\w+(\.\w+)*:\w+")


def load_named(kind: str, name: str, known: Mapping[str, str | type], wanted: type[Wanted]) -> Wanted:
    """Return the object named `name`: one of the package's `known` ones, or a user's own, written `module:NAME`.

    kind: a task, a strategy; names it in messages. known: by name the class, or the place as `module:NAME`. A user's
    module is imported with the working directory on the path, as by `python -m`. A class is instantiated without
    arguments. Raises `InputError` for a name that is neither known nor has a colon, listing the `known` ones, for a
    module that is missing or cannot be imported, a name that the module lacks, a class that cannot be instantiated so,
    and an object without all public members of the protocol `wanted`.
    """
    told = f"{kind} '{name}'"
    found = _load_known(known[name]) if name in known else _load_own(name, told, known)
    if isinstance(found, type):
        try:
            found = found()
        except Exception as error:
            raise InputError(
                f"{told}: makes nothing without arguments ({_describe_exception(error)}); name an instance"
            ) from None
    if lacking := [name for name in vars(wanted) if not name.startswith("_") and not hasattr(found, name)]:
        raise InputError(f"{told}: is no {kind}, it has no {', '.join(lacking)}")
    return found


def _load_known(known: str | type) -> Any:
    if isinstance(known, type):
        return known
    module, _, attribute = known.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _load_own(name: str, told: str, known: Iterable[str]) -> Any:
    place, colon, attribute = name.partition(":")
    if not colon:
        closest = suggest(name, known)
        raise InputError(f"{told}: choose one of {', '.join(known)}, or name your own as module:NAME{closest}")
    if not PLACE.fullmatch(name):
        raise InputError(f"{told}: a module, a colon and a name in it are wanted, as in my_package.my_module:NAME")
    module = _imported(place, told)
    if not hasattr(module, attribute):
        raise InputError(f"{told}: {module.__file__} has no '{attribute}'")
    return getattr(module, attribute)


def _imported(place: str, told: str) -> ModuleType:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        return importlib.import_module(place)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{place}.".startswith(f"{error.name}."):
            raise InputError(f"{told}: no module '{error.name}' in {here} or among what is installed") from None
        raise InputError(f"{told}: cannot be imported ({_describe_exception(error)})") from None
    except (Exception, SystemExit) as error:
        raise InputError(f"{told}: cannot be imported ({_describe_exception(error)})") from None


def _describe_exception(error: BaseException) -> str:
    """Return the type and message of an exception, and the file and line that raised it."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = "" if trace is None else f", {Path(trace.tb_frame.f_code.co_filename).name} line {trace.tb_lineno}"
    return f"{type(error).__name__}: {error}{where}"
