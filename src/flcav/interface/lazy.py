"""Lazy imports: module attributes that are imported on first access (PEP 562)."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from importlib import import_module
from typing import Any

from flcav.interface.fields import document_fields


def lazy_names(package: str, places: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` for `package`; `places` maps each public name to the module that defines it.

    The returned `__getattr__` raises AttributeError for any other name.
    """

    def __getattr__(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(import_module(places[name]), name)
        if isinstance(found, type) and (is_dataclass(found) or hasattr(found, "model_fields")):
            document_fields(found)
        setattr(sys.modules[package], name, found)  # so that it is looked up once
        return found

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *places})

    return __getattr__, __dir__
