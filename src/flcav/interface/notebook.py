"""Display in notebooks: records as pictures or tables by `flcav.plot`, and interrupted calls as one sentence."""

import functools
from collections.abc import Callable
from importlib import import_module
from typing import ParamSpec, TypeVar

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


class Displayed:
    """Mixin of records that a notebook displays as a picture or table; `flcav.plot` is imported on first display."""

    __slots__ = ()

    def _repr_html_(self) -> str | None:
        """Return a table as HTML; None for a record that is displayed as a picture."""
        return import_module("flcav.plot").as_table(self)

    def _repr_png_(self) -> bytes | None:
        """Return a picture as a PNG file; None for a record that is displayed as a table."""
        return import_module("flcav.plot").picture(self)


def resumable(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a resumable function: on Ctrl-C, its KeyboardInterrupt says that the same call continues the work."""

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        try:
            return function(*args, **kwargs)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                "interrupted; finished parts are kept, and the same call goes on from them"
            ) from None

    return call
