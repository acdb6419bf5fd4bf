"""Parking spaces, and objects beside the roads, of the map that a town was imported from."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon

from flcav.world.map.layers import Marking
from flcav.world.map.parameters import ObjectParameters, ParkingParameters
from flcav.world.map.surfaces import make_footprint

Array = NDArray[np.float64]

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


def outline_objects(objects: Sequence[ObjectParameters]) -> list[Polygon]:
    """Return the footprints of objects, world frame [m]; those of trees are as wide as their crowns."""
    return [make_footprint(each.x, each.y, np.radians(each.yaw_deg), each.length_m, each.width_m) for each in objects]


def list_buildings(objects: Sequence[ObjectParameters]) -> Array:
    """Return the buildings (B, 6) among objects: x, y, yaw, length, width, height [m, rad]."""
    return _list_rows(objects, "building")


def list_trees(objects: Sequence[ObjectParameters]) -> Array:
    """Return the trees (T, 4) among objects: x, y, height, crown radius [m]."""
    rows = _list_rows(objects, "tree")
    return np.column_stack((rows[:, 0], rows[:, 1], rows[:, 5], rows[:, 3:5].mean(axis=1) / 2))


def list_clutter(objects: Sequence[ObjectParameters]) -> tuple[tuple[str, Array], ...]:
    """Return all other objects by kind of clutter: rows (K, 6) x, y, yaw, length, width, height [m, rad]."""
    kinds = sorted({each.kind for each in objects} - {"building", "tree"})
    return tuple((kind, _list_rows(objects, kind)) for kind in kinds)


def _list_rows(objects: Sequence[ObjectParameters], kind: str) -> Array:
    rows = [
        (each.x, each.y, float(np.radians(each.yaw_deg)), each.length_m, each.width_m, each.height_m)
        for each in objects
        if each.kind == kind
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)
