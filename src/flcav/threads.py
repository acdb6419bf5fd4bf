"""Thread count of the numerical libraries. It decides the order of sums, and so the last bits of results."""

import contextlib
import os
import sys
from collections.abc import Iterator

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
    """Set the environment variables in VARIABLES to `count` within the context: processes started there inherit it."""
    before = {name: os.environ.get(name) for name in VARIABLES}
    os.environ.update(dict.fromkeys(VARIABLES, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
