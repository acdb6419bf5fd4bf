"""Threads of the numerical libraries: their number decides the order of sums, and with it the last bits of a result."""

import os
import sys

VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def use_threads(count: int) -> None:
    """Have this process, and those it starts, compute on `count` threads each.

    Libraries read the environment when they are loaded; of those that are loaded, torch is told.
    """
    os.environ.update(dict.fromkeys(VARIABLES, str(count)))
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(count)
