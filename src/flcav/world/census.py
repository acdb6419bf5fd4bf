"""What a town has, counted."""

from shapely.geometry import LineString

from flcav.world.roads import read_net
from flcav.world.town import Town


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
