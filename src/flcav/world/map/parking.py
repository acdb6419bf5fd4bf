"""Parking spaces of the map that a town was imported from: outlines, paint, and the vehicles in them."""

from collections.abc import Iterator, Sequence

import numpy as np
from shapely.geometry import Polygon

from flcav.world.map.layers import Marking
from flcav.world.map.parameters import ParkingParameters
from flcav.world.map.surfaces import make_footprint

LINE_M = 0.12  # width of the lines


def outline_space(space: ParkingParameters) -> Polygon:
    """Return the outline of a parking space, world frame [m]."""
    return make_footprint(space.x, space.y, np.radians(space.yaw_deg), space.length_m, space.width_m)


def paint_spaces(spaces: Sequence[ParkingParameters]) -> Iterator[Marking]:
    """Yield the lines around parking spaces, inside their outlines."""
    for space in spaces:
        inner = outline_space(space).buffer(-LINE_M / 2, join_style="mitre")
        corners = np.asarray(inner.exterior.coords)
        for i in range(4):
            yield Marking("solid", corners[i : i + 2], LINE_M, 0.0, 0.0)
