"""How busy the surroundings of candidate sites are: what conventional sensor placement goes by."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.world.trace import Trace

Array = NDArray[np.float64]


def mean_actors(sites: Array, traces: Trace | Sequence[Trace], range_m: float) -> Array:
    """Return (P,) the mean number of actors within `range_m` of each site (P, 3), over all instants of `traces` [m].

    Counts every present actor, moving or parked, vehicle or pedestrian, by the 3D distance of its box's centre.
    """
    traces = [traces] if isinstance(traces, Trace) else traces
    total, instants = np.zeros(len(sites)), 0
    for trace in traces:
        centre = trace.position + np.array([0.0, 0.0, 0.5]) * trace.size[:, 2:]
        for i, site in enumerate(sites):
            total[i] += (np.linalg.norm(centre - site, axis=2) <= range_m).sum()  # absent is NaN: never within
        instants += len(trace.time_s)
    return total / max(instants, 1)
