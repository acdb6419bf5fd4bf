"""Numba's compiler with its results kept on disk, so that only the first process on a machine waits for it."""

from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` compiled on its first call, without the interpreter's lock.

    The result is kept beside the source, else in the user's cache folder (or in NUMBA_CACHE_DIR, where that is set);
    where none of them can be written it lasts as long as the process.
    """
    try:
        return numba.njit(nogil=True, cache=True)(function)
    except RuntimeError:  # nowhere to keep it
        return numba.njit(nogil=True)(function)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` for use inside compiled ones, each of which gets a copy of its body.

    A call costs two atomic operations for every array passed, records of arrays included: too much for every pixel.
    """
    return numba.njit(nogil=True, inline="always")(function)
