"""Parked vehicles, drawn anew for every traffic seed."""

from dataclasses import dataclass

import numpy as np
from shapely.geometry import LineString

from flcav.geometry import wrap_angle
from flcav.world.parameters import TownParameters
from flcav.world.placement import Verge
from flcav.world.roads import RoadNet
from flcav.world.shapes import SHAPES

FROM_JUNCTION_M = 6.0  # kept free at both ends of a parking lane
KERB_GAP_M = (0.1, 0.3)  # between wheels and kerb
BUMPER_GAP_M = (0.6, 1.8)  # between neighbours
CROOKED = 0.12  # share of drivers who do not care
BACKWARDS = 0.06  # share parked against the traffic
OVERHANG_M = 0.1  # how far a wide vehicle may stand out of its lane


@dataclass(frozen=True)
class Parked:
    """One parked vehicle."""

    category: str
    shape: int  # index within the category
    x: float
    y: float
    yaw: float


def park(net: RoadNet, parameters: TownParameters, random: np.random.Generator) -> list[Parked]:
    """Return the vehicles on the parking lanes of all streets: inside their lane, apart from each other."""
    out = []
    for edge in net.streets:
        street = parameters.streets[edge.type]
        categories = list(street.parked_mix)
        shares = np.array([street.parked_mix[category] for category in categories])
        for lane in edge.lanes_of("parking"):
            verge = Verge(LineString(lane.shape), lane.width / 2, street)
            along = FROM_JUNCTION_M + random.uniform(0.0, 3.0)
            while True:
                category = categories[int(random.choice(len(categories), p=shares / shares.sum()))]
                shape = int(random.choice(len(SHAPES[category]), p=parameters.shape_weights(category)))
                length, width = SHAPES[category][shape].length, SHAPES[category][shape].width
                taken, backwards = random.random() < street.parked, random.random() < BACKWARDS
                crooked = random.normal(0.0, 0.07 if random.random() < CROOKED else 0.012)
                kerb_gap, bumper_gap = random.uniform(*KERB_GAP_M), random.uniform(*BUMPER_GAP_M)
                if along + length > verge.line.length - FROM_JUNCTION_M:
                    break
                if taken and width < lane.width + OVERHANG_M:
                    room = lane.width + OVERHANG_M - width
                    crooked = float(np.clip(crooked, -0.8 * room / length, 0.8 * room / length))
                    needed = width + length * abs(np.sin(crooked))
                    right = lane.width / 2 - min(kerb_gap, lane.width + OVERHANG_M - needed) - needed / 2
                    x, y, heading = verge.at(along + length / 2, right)
                    yaw = float(wrap_angle(heading + crooked + np.pi * backwards))
                    out.append(Parked(category, shape, x, y, yaw))
                along += length + bumper_gap
    return out
