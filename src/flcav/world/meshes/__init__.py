"""Parametric meshes of actors: no third-party assets; every shape has exactly its outer dimensions."""

from functools import lru_cache

from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, box
from flcav.world.shapes import SHAPES

__all__ = ["Mesh", "actor_mesh"]


@lru_cache(maxsize=64)
def actor_mesh(category: str, shape: int) -> Mesh:
    """Return the mesh of `SHAPES[category][shape]` in its body frame: ground centre at the origin, x forward."""
    wanted = SHAPES[category][shape]
    return box((0, 0, wanted.height / 2), wanted[1:], Material.PAINT)
