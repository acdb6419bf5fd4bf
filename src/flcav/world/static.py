"""A town's static content as one mesh."""

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

from flcav.seeds import stream
from flcav.world.materials import Material
from flcav.world.meshes.buildings import building
from flcav.world.meshes.furniture import clutter, lamp, sensor_mast, sign
from flcav.world.meshes.mesh import Mesh, join, moved, sheet
from flcav.world.meshes.plants import tree
from flcav.world.town import KERB_M, Town

GROUND_M = -0.03  # open ground lies a little below the road
LAND_M = 150.0  # ground beyond the town's bounds


def town_mesh(town: Town) -> Mesh:
    """Return everything of `town` that stands still, world frame. The same town gives the same mesh."""
    return join([_ground(town), *_roads(town), *_sidewalks(town), *_buildings(town), *_plants(town), *_furniture(town)])


def _ground(town: Town) -> Mesh:
    x0, y0, x1, y1 = town.bounds
    x = np.linspace(x0 - LAND_M, x1 + LAND_M, 16)
    y = np.linspace(y0 - LAND_M, y1 + LAND_M, 16)
    points = np.stack(np.broadcast_arrays(x[:, None], y[None], GROUND_M), axis=-1)
    return sheet(points, Material.GROUND)


def _roads(town: Town) -> Iterator[Mesh]:
    return (_plate(polygon, 0.0, Material.ROAD) for polygon in town.roads)


def _sidewalks(town: Town) -> Iterator[Mesh]:
    for polygon in town.sidewalks:
        yield _plate(polygon, KERB_M, Material.SIDEWALK)
        ring = np.concatenate((polygon, polygon[:1]))
        heights = (GROUND_M, KERB_M)
        yield sheet(np.stack([np.c_[ring, np.full(len(ring), z)] for z in heights]), Material.SIDEWALK)


def _plate(polygon: NDArray[np.float64], z: float, material: Material) -> Mesh:
    """Return a polygon (K, 2) as a level surface."""
    triangles = shapely.constrained_delaunay_triangles(shapely.Polygon(polygon))
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
    vertices = np.c_[corners, np.full(len(corners), z)].astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, faces, np.full(len(faces), material, np.uint8))


def _buildings(town: Town) -> Iterator[Mesh]:
    rng = stream(0, "facades", town.name)
    for x, y, yaw, length, width, height in town.buildings:
        yield moved(building(length, width, height, rng), x, y, 0.0, yaw)


def _plants(town: Town) -> Iterator[Mesh]:
    rng = stream(0, "leaves", town.name)
    for x, y, height, radius in town.trees:
        yield moved(tree(height, radius, rng), x, y)


def _furniture(town: Town) -> Iterator[Mesh]:
    for kind, rows in town.clutter:
        for x, y, yaw, length, width, height in rows:
            yield moved(clutter(kind, length, width, height), x, y, 0.0, yaw)
    for x, y, height in town.lamps:
        yield moved(lamp(height), x, y)
    for (x, y, z), yaw, kind in zip(town.signs.position, town.signs.yaw, town.signs.kind):
        yield moved(sign(kind, z), x, y, 0.0, yaw)
    for (x, y, z), yaw in zip(town.poles.position, town.poles.yaw):
        yield moved(sensor_mast(z), x, y, 0.0, yaw)
