"""Memory of the process: what the C library keeps of what is freed, and the collector of cyclic garbage."""

import contextlib
import ctypes
import gc
import platform
from collections.abc import Iterator
from functools import lru_cache

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
