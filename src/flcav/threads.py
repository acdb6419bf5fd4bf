"""Thread count of the numerical libraries. It decides the order of sums, and so the last bits of results."""

import os
import sys

VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def use_threads(count: int) -> None:
    """Set the thread count of the numerical libraries in this process and its children.

    Sets the environment variables in VARIABLES, which a library reads when it is loaded, and torch's own setting if
    torch is loaded already; other libraries loaded before keep theirs.
    """
    os.environ.update(dict.fromkeys(VARIABLES, str(count)))
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(count)
