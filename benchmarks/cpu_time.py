"""Median CPU time of several functions, run in turns."""

import time
from collections.abc import Callable, Sequence

import numpy as np


def cpu_ms(works: Sequence[Callable[[], object]], repeats: int) -> list[float]:
    """Return the median CPU time [ms] of each of `works`, run in turns so that load slows them alike."""
    taken = np.empty((repeats, len(works)))
    for repeat in range(-1, repeats):
        for number, work in enumerate(works):
            start = time.process_time()
            work()
            taken[repeat, number] = time.process_time() - start
    return [1e3 * float(value) for value in np.median(taken, axis=0)]
