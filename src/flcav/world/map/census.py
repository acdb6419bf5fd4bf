"""Counts of a town: its streets, buildings and furniture, and the road users around each pole."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import LineString

from flcav.world.map.roads import read_net
from flcav.world.map.town import Town
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


def census(town: Town) -> dict[str, float]:
    """Return how much there is of what in a town: lengths in km, extents in m, all else in numbers."""
    net = read_net(town.net)
    x_low, y_low, x_high, y_high = town.bounds
    arms: dict[str, set[str]] = {}
    for edge in net.streets:
        arms.setdefault(edge.start, set()).add(edge.end)
        arms.setdefault(edge.end, set()).add(edge.start)

    def km(kind: str) -> float:
        metres = sum(LineString(lane.shape).length for edge in net.streets for lane in edge.lanes_of(kind))
        return round(metres / 1000, 2)

    return {
        "width_m": round(x_high - x_low, 1),
        "height_m": round(y_high - y_low, 1),
        "driving_km": km("driving"),
        "sidewalk_km": km("sidewalk"),
        "junctions": sum(len(others) > 2 for others in arms.values()),
        "lights": sum(junction.kind.startswith("traffic_light") for junction in net.junctions.values()),
        "crossings": sum(edge.function == "crossing" for edge in net.edges.values()),
        "buildings": len(town.buildings),
        "trees": len(town.trees),
        "signs": len(town.signs.kind),
        "poles": len(town.poles.id),
        "vehicles": town.parameters.vehicles,
        "pedestrians": town.parameters.pedestrians,
    }
