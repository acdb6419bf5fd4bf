"""Meshes of buildings: walls with balconies, sills and porches under a flat or a gabled roof."""

import numpy as np

from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, box, join_meshes, sheet, transform_mesh

STOREY_M = 3.0  # height of a storey
BAY_M = 4.5  # width of a bay of the facade
GABLED_BELOW_M = 9.0  # buildings lower than this have a gabled roof


def make_building(length: float, width: float, height: float, rng: np.random.Generator) -> Mesh:
    """Return a building of these dimensions [m] about its ground centre, `length` along x; `rng` draws its facades."""
    walls = height * 0.68 if height < GABLED_BELOW_M else height - 0.5
    parts = [box((0, 0, walls / 2), (length, width, walls), Material.WALL)]
    parts.append(_gable(length, width, walls, height) if height < GABLED_BELOW_M else _parapet(length, width, walls))
    for turned, (along, depth) in enumerate(((length, width), (width, length))):
        for side in (-1, 1):
            front = _facade(along, depth, walls, rng)
            if front is not None:
                parts.append(transform_mesh(front, 0, 0, 0, np.pi / 2 * turned + (np.pi if side < 0 else 0)))
    return join_meshes(parts)


def _facade(along: float, depth: float, walls: float, rng: np.random.Generator) -> Mesh | None:
    """Return the balconies, sills and porches of the side at y = `depth` / 2, or None where it has no bay."""
    bays = int(along // BAY_M)
    storeys = int(walls // STOREY_M)
    parts = []
    balconies = rng.random() < 0.6
    for bay in range(bays):
        x = (bay - (bays - 1) / 2) * along / bays
        for storey in range(storeys):
            z = storey * STOREY_M
            if storey == 0:
                reach, size = (0.35, (1.6, 0.7, 0.12)) if rng.random() < 0.25 else (0.05, (1.4, 0.1, 0.12))
                parts.append(box((x, depth / 2 + reach, z + 2.4), size, Material.ROOF))
            elif balconies and rng.random() < 0.8:
                parts.append(box((x, depth / 2 + 0.5, z), (2.4, 1.0, 0.15), Material.ROOF))
                parts.append(box((x, depth / 2 + 0.97, z + 0.5), (2.4, 0.06, 0.9), Material.METAL))
            else:
                parts.append(box((x, depth / 2 + 0.06, z + 0.9), (1.5, 0.12, 0.12), Material.ROOF))
    return join_meshes(parts) if parts else None


def _parapet(length: float, width: float, walls: float) -> Mesh:
    return box((0, 0, walls + 0.25), (length + 0.4, width + 0.4, 0.5), Material.ROOF)


def _gable(length: float, width: float, walls: float, height: float) -> Mesh:
    """Return a gabled roof with its ridge along the longer side, from the height `walls` to `height` [m]."""
    turned = width > length
    along, across = (width, length) if turned else (length, width)
    x = np.array((-1.0, 1.0)) * (along / 2 + 0.3)
    slopes = [[(end, y * (across / 2 + 0.3), z) for y, z in ((-1, walls), (0, height), (1, walls))] for end in x]
    ends = [[(end, y * across / 2, z) for y, z in ((-1, walls), (0, height - 0.1), (1, walls))] for end in x * 0.97]
    walled = [Mesh(np.array(end, np.float32), np.array([[0, 1, 2]], np.int32), _one(Material.WALL)) for end in ends]
    return transform_mesh(join_meshes((sheet(slopes, Material.ROOF), *walled)), 0, 0, 0, np.pi / 2 if turned else 0.0)


def _one(material: Material) -> np.ndarray:
    """Return the material of a mesh of one face."""
    return np.array([material], np.uint8)
