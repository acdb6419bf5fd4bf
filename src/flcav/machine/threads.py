"""Thread count of the numerical libraries, work shared among threads, and the memory that a process keeps.

The thread count of the libraries decides the order of sums, and so the last bits of results.
"""

import contextlib
import ctypes
import gc
import os
import platform
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def use_threads(count: int) -> None:
    """Set the thread count of the numerical libraries in this process and its children.

    Sets the environment variables in VARIABLES, which a library reads when it is loaded, and torch's own setting if
    torch is loaded already; other libraries loaded before keep theirs.
    """
    os.environ.update(dict.fromkeys(VARIABLES, str(count)))
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(count)


@contextlib.contextmanager
def threads_of_children(count: int) -> Iterator[None]:
    """Set the environment variables in VARIABLES to `count` within the context: processes started there inherit it.

    Such a process does not import from the working directory either, where a file may have the name of a module.
    """
    values = dict.fromkeys(VARIABLES, str(count)) | {"PYTHONSAFEPATH": "1"}
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def share_among_threads(work: Callable[[int, int], None], count: int, threads: int, *, whole: int = 1) -> None:
    """Call `work(first, last)` for contiguous ranges of `count` items, each in a thread: the first in the caller's own.

    Ranges but the last have a multiple of `whole` items. `work` does not share its own work so.
    """
    step = -(-count // (threads * whole)) * whole
    starts = range(step, count, step) if step else ()
    others = [_pool(os.getpid()).submit(work, first, min(first + step, count)) for first in starts]
    work(0, min(step, count))
    for other in others:
        other.result()


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of this `process`, which a forked one does not inherit."""
    return ThreadPoolExecutor()


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3)
KEPT_BYTES = 64 << 20  # of freed memory that stays with the process
LARGEST_BYTES = 32 << 20  # the largest M_MMAP_THRESHOLD that glibc accepts


@lru_cache(maxsize=1)
def keep_freed_memory() -> None:
    """Make glibc keep up to `KEPT_BYTES` of freed memory in this process; does nothing with other C libraries.

    By default glibc returns freed arrays of megabytes to the system, and the pages of the next image's arrays must be
    mapped and cleared again: a seventh of the time of an image.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, LARGEST_BYTES)
        library.mallopt(_TRIM_THRESHOLD, KEPT_BYTES)


@contextlib.contextmanager
def pause_collector() -> Iterator[None]:
    """Pause the collector of cyclic garbage, which looks at many new objects again and again."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
