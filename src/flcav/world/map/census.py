"""Town statistics and traffic density.

`summarise_town` counts a town's streets, buildings and furniture. `measure_traffic_density` returns the traffic density
around candidate sites, the criterion of conventional sensor placement.
"""

from collections.abc import Sequence

import numpy as np
from shapely.geometry import LineString

from flcav.arrays import Array
from flcav.world.map.roads import read_net
from flcav.world.map.town import Town
from flcav.world.trace import Trace


def measure_traffic_density(sites: Array, traces: Trace | Sequence[Trace], range_m: float) -> Array:
    """Return the traffic density (P,) at sites: the mean number of actors within `range_m` [m], over all instants.

    `sites` (P, 3) are in the world frame [m]. All present actors count, moving or parked, vehicle or pedestrian, by the
    3D distance from the site to the centre of the box. It is zero without traces.
    """
    traces = [traces] if isinstance(traces, Trace) else traces
    total, instants = np.zeros(len(sites)), 0
    for trace in traces:
        centre = trace.position + np.array([0.0, 0.0, 0.5]) * trace.size[:, 2:]
        for i, site in enumerate(sites):
            total[i] += (np.linalg.norm(centre - site, axis=2) <= range_m).sum()  # an absent actor is NaN: not within
        instants += len(trace.time_s)
    return total / max(instants, 1)


def summarise_town(town: Town) -> dict[str, float]:
    """Return the statistics of a town by name.

    `width_m` and `height_m` are the extents of its bounds [m]; `driving_km` and `sidewalk_km` the total length of these
    lanes [km]; `junctions` the number of nodes with three or more neighbours, `lights` that of junctions with traffic
    lights; `vehicles` and `pedestrians` the number moving at the same time; all others are plain counts.
    """
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
