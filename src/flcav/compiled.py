"""Numba's compiler with its results kept on disk, so that only the first process on a machine waits for it."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

import numba

P = ParamSpec("P")
T = TypeVar("T")


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """Return `function` compiled on its first call, without the interpreter's lock.

    The result is kept beside the source, else in the user's cache folder (or in NUMBA_CACHE_DIR, where that is set);
    where none of them can be written it lasts as long as the process. It is made anew when a source changes: Numba sees
    to the function's own file, the name to those of the compiled functions that it calls.
    """
    if sources := _inlined_files(function):
        digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(sources)))
        function.__qualname__ += f"_{digest.hexdigest()[:12]}"
    try:
        return numba.njit(nogil=True, cache=True)(function)
    except RuntimeError:  # nowhere to keep it
        return numba.njit(nogil=True)(function)


def inlined(function: Callable[P, T]) -> Callable[P, T]:
    """Return `function` for use inside compiled ones, each of which gets a copy of its body.

    A call costs two atomic operations for every array passed, records of arrays included: too much for every pixel.
    """
    return numba.njit(nogil=True, inline="always")(function)


def _inlined_files(function: Callable[P, T]) -> set[Path]:
    """Return the files of all compiled functions that `function` calls by name, and of those that they call."""
    files: set[Path] = set()
    met, waiting = {function}, [function]
    while waiting:
        caller = waiting.pop()
        called = (getattr(caller.__globals__.get(name), "py_func", None) for name in caller.__code__.co_names)
        fresh = {each for each in called if each is not None} - met
        files |= {Path(each.__code__.co_filename) for each in fresh}
        met |= fresh
        waiting += fresh
    return files
