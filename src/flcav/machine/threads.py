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
