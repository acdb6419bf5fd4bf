"""Traffic demand: SUMO's route file with random tours, and parked vehicles along the streets.

Vehicles and pedestrians travel until the end of the run. Tours and parked vehicles are redrawn for every traffic seed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import shapely
from shapely.geometry import LineString

from flcav.arrays import Array, Mask
from flcav.geometry import wrap_angle
from flcav.statistics.streams import stream
from flcav.world.map.parameters import TownParameters
from flcav.world.map.roads import Edge, RoadNet
from flcav.world.map.street_furniture import Verge, outline_space
from flcav.world.shapes import ANGLED, RARE, SHAPES
from flcav.world.traffic.passages import find_driven, find_passages, find_walked

FROM_JUNCTION_M = 6.0  # length without vehicles at both ends of a parking lane
KERB_GAP_M = (0.1, 0.3)  # limits of the gap between wheels and kerb
BUMPER_GAP_M = (0.6, 1.8)  # limits of the gap between neighbouring vehicles
CROOKED = 0.12  # share of vehicles parked at a larger angle
ANGLE_RAD = (0.35, 0.75)  # limits of the angle of vehicles parked half on the pavement
BACKWARDS = 0.06  # share of vehicles parked against the driving direction
VANS = 0.1  # share of vans in the parking spaces of a map
DOOR_M = 0.2  # least excess width of a parking space over its vehicle
OVERHANG_M = 0.1  # greatest overhang of a parked vehicle over its lane
DRIVER = {  # attributes of SUMO's vehicle types by category, where they differ from the defaults
    "car": {"vClass": "passenger", "speedFactor": "normc(1,0.1,0.75,1.2)", "minGap": "2.0"},
    "van": {"vClass": "delivery", "speedFactor": "normc(0.95,0.1,0.7,1.1)", "minGap": "2.0"},
    "truck": {"vClass": "truck", "speedFactor": "normc(0.9,0.1,0.7,1.0)", "minGap": "2.5"},
    "bus": {"vClass": "bus", "speedFactor": "normc(0.85,0.1,0.7,1.0)", "minGap": "2.5"},
    "motorcycle": {"vClass": "motorcycle", "speedFactor": "normc(1.05,0.1,0.8,1.3)", "minGap": "1.5"},
    "bicycle": {"vClass": "bicycle", "maxSpeed": "5.0", "minGap": "1.0"},
    "pedestrian": {"vClass": "pedestrian", "maxSpeed": "1.6", "speedFactor": "normc(0.8,0.15,0.4,1.0)"},
}
CAV_TYPE = "car.sedan"
HEADWAY_S = 2.0  # least time between two vehicles that enter at the same place
NEXT_M = 5.0  # least distance between consecutive destinations, if there is a choice
FASTEST = 20.0  # vehicle speed for which tours are long enough [m/s]
FASTEST_WALK = 1.7  # pedestrian speed for which tours are long enough [m/s]


@dataclass(frozen=True)
class Parked:
    """A parked vehicle: its shape and pose, world frame."""

    category: str
    shape: int  # row of SHAPES[category]
    x: float  # ground centre [m]
    y: float  # ground centre [m]
    yaw: float  # [rad]


def park(net: RoadNet, parameters: TownParameters, random: np.random.Generator) -> list[Parked]:
    """Draw the parked vehicles on the parking lanes of all streets, by the parameters of the street types.

    They do not overlap, and overhang their lane by at most `OVERHANG_M`. Parking spaces of a map are occupied at
    random; a parking lane with such spaces has no other vehicles.
    """
    spaces = shapely.union_all([outline_space(space) for space in parameters.parking])
    out = []
    for edge in net.streets:
        street = parameters.streets[edge.type]
        categories = list(street.parked_mix)
        shares = np.array([street.parked_mix[category] for category in categories])
        for lane in edge.lanes_of("parking"):
            verge = Verge(LineString(lane.shape), lane.width / 2, street, net.side)
            if verge.line.buffer(lane.width / 2, cap_style="flat").intersects(spaces):
                continue
            along = FROM_JUNCTION_M + random.uniform(0.0, 3.0)
            while True:
                category = categories[int(random.choice(len(categories), p=shares / shares.sum()))]
                shape = _draw_parked_shape(category, parameters, random)
                length, width = SHAPES[category][shape].length, SHAPES[category][shape].width
                taken, backwards = random.random() < street.parked, random.random() < BACKWARDS
                crooked = random.normal(0.0, 0.07 if random.random() < CROOKED else 0.012)
                kerb_gap, bumper_gap = random.uniform(*KERB_GAP_M), random.uniform(*BUMPER_GAP_M)
                if along + length > verge.line.length - FROM_JUNCTION_M:
                    break
                angled = parameters.rare.get(ANGLED, 0.0) if category == RARE[ANGLED] else 0.0
                if angled and random.random() < angled:
                    crooked = float(random.choice((-1, 1)) * random.uniform(*ANGLE_RAD))
                elif taken and width < lane.width + OVERHANG_M:
                    room = lane.width + OVERHANG_M - width
                    crooked = float(np.clip(crooked, -0.8 * room / length, 0.8 * room / length))
                if taken and width < lane.width + OVERHANG_M:
                    needed = width + length * abs(np.sin(crooked))
                    right = lane.width / 2 - min(kerb_gap, lane.width + OVERHANG_M - needed) - needed / 2
                    x, y, heading = verge.at(along + length / 2, right)
                    yaw = float(wrap_angle(heading + crooked + np.pi * backwards))
                    out.append(Parked(category, shape, x, y, yaw))
                along += length + bumper_gap
    return out + list(_park_in_spaces(parameters, random))


def _park_in_spaces(parameters: TownParameters, random: np.random.Generator) -> Iterator[Parked]:
    """Yield vehicles in the parking spaces of a map that they fit into: centred, in either direction."""
    for space in parameters.parking:
        taken, category = random.random() < parameters.parking_taken, "van" if random.random() < VANS else "car"
        shape = _draw_parked_shape(category, parameters, random)
        yaw = np.radians(space.yaw_deg) + random.normal(0.0, 0.015) + np.pi * (random.random() < 0.5)
        size = SHAPES[category][shape]
        if taken and size.length <= space.length_m and size.width + DOOR_M <= space.width_m:
            yield Parked(category, shape, space.x, space.y, float(wrap_angle(yaw)))


def _draw_parked_shape(category: str, parameters: TownParameters, random: np.random.Generator) -> int:
    """Draw the shape of a parked vehicle: a row of `SHAPES[category]`."""
    return int(random.choice(len(SHAPES[category]), p=parameters.shape_weights(category, parked=True)))


class Successor(NamedTuple):
    """A vehicle that enters when another one has left."""

    name: str
    type: str  # SUMO's vehicle type
    edges: list[str]  # its whole route


@dataclass(frozen=True)
class Demand:
    """The traffic demand of a run."""

    routes: str  # SUMO's route file (XML)
    followers: dict[str, Successor]  # by the name of the predecessor; empty if all tours are long enough


def write_demand(
    net: RoadNet, parameters: TownParameters, *, seed: int, cavs: int, from_s: float, until_s: float, fill_s: float
) -> Demand:
    """Draw the traffic demand of a town: a trip for every vehicle and pedestrian.

    CAVs depart at 0 s, all others at a uniformly random time before `fill_s` [s]. A tour of random destinations is too
    long to be finished by `until_s` [s] at `FASTEST` or `FASTEST_WALK`. Vehicles draw destinations by the street type's
    `traffic`, pedestrians by its `footfall`; CAVs draw the approaches of the candidate poles, if there are any.

    In a net with open ends, where no tour is long enough, a CAV enters shortly before `from_s` [s] and drives on until
    after `until_s`, below the speed limit if all routes are short; another vehicle drives to an exit, and its successor
    enters when it has left. Raises `InputError` where no route is long enough for a CAV.
    """
    root = Element("routes")
    for category, shapes in SHAPES.items():
        for shape in shapes:
            size = {"length": shape.length, "width": shape.width, "height": shape.height}
            attributes = {name: str(value) for name, value in size.items()}
            SubElement(root, "vType", {"id": f"{category}.{shape.name}"} | DRIVER[category] | attributes)
    driven = [edge for edge in net.streets if edge.lanes_of("driving")]
    walked = [edge for edge in net.streets if edge.lanes_of("sidewalk")]
    traffic = np.array([parameters.streets[edge.type].traffic for edge in driven])
    footfall = np.array([parameters.streets[edge.type].footfall for edge in walked])
    watched = weigh_pole_approaches(net, parameters)
    watching = np.array([watched.get(edge.id, 0.0) for edge in driven])
    by_car, on_foot = find_driven(net, driven), find_walked(net, walked)
    mid_car, mid_foot = find_middles(driven), find_middles(walked)
    reach = FASTEST * until_s
    trips: list[tuple[float, Element]] = []
    passages = find_passages(net, driven)
    exits = {edge.id for edge, left_s in zip(driven, passages.left_s) if np.isfinite(left_s)}  # empty in a closed net
    for i in range(cavs):
        random = stream(seed, "cav", i)
        weight, depart, share = watching if watching.any() else traffic, 0.0, None
        edges = draw_tour(driven, mid_car, by_car, weight, reach, random, anywhere=True)
        if edges[-1] in exits:
            depart = round(max(from_s - (i + 1) * HEADWAY_S, 0.0), 1)
            least_s = until_s - depart
            slowed, share = passages.slow_down(least_s)
            edges = [driven[row].id for row in slowed.draw(weight, random, least_s=least_s, most_s=least_s)]
        trips.append((depart, _vehicle(f"cav{i}", CAV_TYPE, depart, edges, entering=depart > 0, share=share)))
    categories = list(parameters.mix)
    shares = np.array([parameters.mix[category] for category in categories])
    followers: dict[str, Successor] = {}
    for i in range(parameters.vehicles):
        random = stream(seed, "vehicle", i)
        kind = draw_type(categories[int(random.choice(len(categories), p=shares / shares.sum()))], parameters, random)
        depart = round(float(random.uniform(0.0, fill_s)), 1)
        tour = draw_tour(driven, mid_car, by_car, traffic, reach, random)
        if tour[-1] not in exits:
            trips.append((depart, _vehicle(f"veh{i}", kind, depart, tour)))
            continue
        name = f"veh{i}"
        rest = until_s - depart
        rows = passages.draw(traffic, random, least_s=0.0, most_s=rest)
        trips.append((depart, _vehicle(name, kind, depart, [driven[row].id for row in rows])))
        while (rest := rest - max(float(passages.time_s[rows].sum()), HEADWAY_S)) > 0:
            rows = passages.draw(traffic * passages.entries, random, least_s=0.0, most_s=rest)
            followers[name] = Successor(
                f"veh{parameters.vehicles + len(followers)}", kind, [driven[row].id for row in rows]
            )
            name = followers[name].name
    for i in range(parameters.pedestrians if walked else 0):
        random = stream(seed, "pedestrian", i)
        kind = draw_type("pedestrian", parameters, random)
        depart = round(float(random.uniform(0.0, fill_s)), 1)
        tour = draw_tour(walked, mid_foot, on_foot, footfall, FASTEST_WALK * until_s, random)
        tour = [
            edge for i, edge in enumerate(tour) if edge != tour[i - 1] or not i
        ]  # without walks from an edge to itself
        if len(tour) > 1:
            trips.append((depart, _person(f"ped{i}", kind, depart, tour)))
    for _, trip in sorted(trips, key=lambda item: item[0]):
        root.append(trip)
    return Demand(tostring(root, encoding="unicode"), followers)


def weigh_pole_approaches(net: RoadNet, parameters: TownParameters) -> dict[str, float]:
    """Return the weights of the edges that lead past the candidate poles, by edge; a pole adds 1 in total.

    The edges of a straight pole are both directions of its street; those of another pole lead into its junction.
    """
    out: dict[str, float] = {}
    for pole in parameters.poles:
        street = net.edges[pole.edge]
        if pole.kind == "straight":
            past = [edge.id for edge in net.streets if {edge.start, edge.end} == {street.start, street.end}]
        else:
            past = [edge.id for edge in net.streets if edge.end == street.end]
        for edge in past:
            out[edge] = out.get(edge, 0.0) + 1.0 / len(past)
    return out


def find_middles(edges: Sequence[Edge]) -> Array:
    """Return the middles (N, 2) of the edges' first lanes [m], world frame."""
    return np.array([edge.lanes[0].shape.mean(axis=0) for edge in edges]).reshape(-1, 2)


def draw_tour(
    edges: Sequence[Edge],
    middle: Array,
    reach: Mask,
    weight: Array,
    length_m: float,
    random: np.random.Generator,
    *,
    anywhere: bool = False,
) -> list[str]:
    """Draw a tour by `weight` (N,): the ids of edges to visit, at least `length_m` [m] long as the crow flies.

    `middle` (N, 2) are the edges' places [m], see `find_middles`; `reach` (N, N) whether an edge (column) can be
    reached from another (row). The tour starts where it can continue, if there is such an edge, and ends early where it
    cannot; with `anywhere` it continues on edges without weight if these lead to a loop. Weights that are all zero
    count as equal.
    """
    weight = weight if weight.any() else np.ones(len(edges))
    going_on = weight * (reach & (weight > 0)).any(axis=1)
    share = going_on / going_on.sum() if going_on.any() else weight / weight.sum()
    at = int(random.choice(len(edges), p=share))
    out = [edges[at].id]
    done = 0.0
    while done < length_m:
        steps = np.hypot(*(middle - middle[at]).T)
        share = weight * reach[at]
        if anywhere and not share.any() and (circling := reach[at] & reach.diagonal()).any():
            share = 1.0 * circling
        if not share.any():
            break
        if not (share * (steps >= NEXT_M)).any():
            steps = np.maximum(steps, NEXT_M)  # no destination is farther: repeated visits count
        to = int(random.choice(len(edges), p=share / share.sum()))
        if steps[to] < NEXT_M:
            continue
        out.append(edges[to].id)
        done, at = done + float(steps[to]), to
    return out


def draw_type(category: str, parameters: TownParameters, random: np.random.Generator) -> str:
    """Draw a shape of the category; return its SUMO vehicle type, "category.shape"."""
    weights = parameters.shape_weights(category)
    return f"{category}.{SHAPES[category][int(random.choice(len(weights), p=weights))].name}"


def _vehicle(
    name: str, kind: str, depart: float, edges: list[str], *, entering: bool = False, share: float | None = None
) -> Element:
    """Return SUMO's <trip> of a vehicle along `edges`: from rest on the first one, or `entering` it in motion.

    It drives at `share` of the speed limits, or one that SUMO draws.
    """
    pace = {} if share is None else {"speedFactor": f"{share:.3f}"}
    start = {"departPos": "base", "departSpeed": "max"} if entering else {"departPos": "random_free"}
    row = {"id": name, "type": kind, "depart": f"{depart:.1f}", **start, "departLane": "best"}
    return Element("trip", row | pace | {"from": edges[0], "to": edges[-1], "via": " ".join(edges[1:-1])})


def _person(name: str, kind: str, depart: float, edges: list[str]) -> Element:
    """Return SUMO's <person> element of a pedestrian who walks along `edges`."""
    person = Element("person", {"id": name, "type": kind, "depart": f"{depart:.1f}", "departPos": "random"})
    SubElement(person, "walk", {"from": edges[0], "to": edges[1]})
    for edge in edges[2:]:
        SubElement(person, "walk", {"to": edge})
    return person


def list_vehicle_types() -> Iterator[tuple[str, str, int]]:
    """Yield SUMO's vehicle types with their categories and rows of `SHAPES[category]`."""
    for category, shapes in SHAPES.items():
        for i, shape in enumerate(shapes):
            yield f"{category}.{shape.name}", category, i
