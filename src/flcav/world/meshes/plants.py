"""Trees and bushes: trunks, and crowns of single leaves that some rays pass between."""

import numpy as np
from numpy.typing import ArrayLike

from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, join, tube

LEAVES = 360  # of a tree; each stands for a cluster
LEAF = 0.38  # size of a cluster over the crown's radius: about two rays in three are caught


def tree(height: float, crown_radius: float, rng: np.random.Generator) -> Mesh:
    """Return a tree about the foot of its trunk."""
    crown_foot = 0.32 * height
    middle = np.array((0.0, 0.0, (height + crown_foot) / 2))
    radii = np.array((crown_radius, crown_radius, (height - crown_foot) / 2))
    trunk = tube((0, 0, 0), middle, 0.05 + 0.018 * height, Material.BARK, end_radius=0.05, sides=6, capped=False)
    return join((trunk, leaves(middle, radii, LEAVES, LEAF * crown_radius, rng)))


def leaves(center: ArrayLike, radii: ArrayLike, count: int, size_m: float, rng: np.random.Generator) -> Mesh:
    """Return `count` loose triangles of about `size_m`, densest towards the outside of an ellipsoid."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    inside = 1 - size_m / 2 / np.min(radii)
    place = np.asarray(center) + direction * rng.random((count, 1)) ** 0.2 * np.asarray(radii) * inside
    corners = rng.standard_normal((count, 3, 3))
    corners *= size_m / 2 / np.linalg.norm(corners, axis=2, keepdims=True)
    vertices = (place[:, None] + corners).reshape(-1, 3).astype(np.float32)
    return Mesh(vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3), np.full(count, Material.LEAF, np.uint8))
