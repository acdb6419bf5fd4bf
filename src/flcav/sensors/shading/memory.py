"""Keeping the memory of one image for the next."""

import ctypes
import platform
from functools import lru_cache

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3)
KEPT_BYTES = 64 << 20
LARGEST_BYTES = 32 << 20  # the most that glibc takes


@lru_cache(maxsize=1)
def keep_freed_memory() -> None:
    """Let this process keep up to `KEPT_BYTES` of what it frees, where the C library is glibc; elsewhere do nothing.

    By default glibc hands arrays of megabytes back to the system, which clears every page anew for the next image: a
    seventh of an image's time.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, LARGEST_BYTES)
        library.mallopt(_TRIM_THRESHOLD, KEPT_BYTES)
