"""Just-in-time compilation by Numba, cached on disk: only the first process on a machine compiles."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

import numba

P = ParamSpec("P")
T = TypeVar("T")


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """Return `function` compiled by `numba.njit` on its first call; it runs without the interpreter's lock (GIL).

    The machine code is cached beside the source, else in the user's cache folder (or in NUMBA_CACHE_DIR, where that is
    set); where none of these can be written, it lasts as long as the process. The cache is invalid when a source
    changes: a hash of the bytes of the function's own file, and of the files of the compiled functions that it calls,
    is appended to the qualified name, which is part of the cache's key. (Numba alone reads an index before it compares
    the time of the file, and breaks off where the index names a class that the file no longer has.)
    """
    return _compile(function, counted=True)


def kernel(function: Callable[P, T]) -> Callable[P, T]:
    """Return `function` compiled as `compiled` does, without counts of references to its arrays: it may make none.

    Such counts are atomic. Where a loop over pixels passes arrays to inlined functions, they take half of its time, and
    more where several threads run it, each with the same arrays.
    """
    return _compile(function, counted=False)


def _compile(function: Callable[P, T], *, counted: bool) -> Callable[P, T]:
    sources = {Path(function.__code__.co_filename)} | _inlined_files(function)
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(sources)))
    function.__qualname__ += f"_{digest.hexdigest()[:12]}{'' if counted else '_uncounted'}"
    try:
        return numba.njit(nogil=True, cache=True, _nrt=counted)(function)  # pyright: ignore[reportCallIssue]
    except RuntimeError:  # no folder for the cache can be written
        return numba.njit(nogil=True, _nrt=counted)(function)  # pyright: ignore[reportCallIssue]


def inlined(function: Callable[P, T]) -> Callable[P, T]:
    """Return `function` for use inside kernels, whose machine code gets a copy of its own (inlining).

    It is free of counts of references as they are: a call would cost two atomic ones for every array passed, arrays
    within records included, which is too much for every pixel. Copied as machine code it is compiled once, not once for
    each call, as it would be with Numba's own inlining.
    """
    return numba.njit(nogil=True, forceinline=True, _nrt=False)(function)  # pyright: ignore[reportCallIssue]


def _inlined_files(function: Callable[P, T]) -> set[Path]:
    """Return the source files of the compiled functions that `function` calls by name, directly or indirectly."""
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
