"""Parametric triangle meshes of actors and of a town's objects, without third-party assets."""

from collections.abc import Callable
from functools import lru_cache

from flcav.world.map.parameters import PROPS
from flcav.world.meshes.furniture import make_clutter
from flcav.world.meshes.mesh import Mesh, bow_ends, fit_to_size
from flcav.world.meshes.people import bicycle, motorcycle, pedestrian
from flcav.world.meshes.vehicles import make_bus, make_car, make_truck
from flcav.world.shapes import SHAPES, Shape

__all__ = ["Mesh", "actor_mesh"]

MAKERS: dict[str, Callable[[Shape], Mesh]] = {
    "car": make_car,
    "van": make_car,
    "truck": make_truck,
    "bus": make_bus,
    "motorcycle": motorcycle,
    "bicycle": bicycle,
    "pedestrian": pedestrian,
}


@lru_cache(maxsize=256)
def actor_mesh(category: str, shape: int, size: tuple[float, ...] | None = None) -> Mesh:
    """Return the mesh of an actor, `SHAPES[category][shape]`, in its body frame: origin below its centre, x forward.

    For the category "prop" it is the street furniture `PROPS[shape]`. The mesh has exactly the outer dimensions `size`
    (3,) [m], by default those of the shape; a fourth number is the bow of a vehicle's ends [m], see `bow_ends`. Raises
    `KeyError` and `IndexError` for an unknown category or shape.
    """
    if category == "prop":
        kind, *usual = PROPS[shape]
        return make_clutter(kind, *(size or usual)[:3])
    wanted = SHAPES[category][shape]
    length, width, height, *bow = size or wanted[1:]
    mesh = fit_to_size(MAKERS[category](wanted), length, width, height)
    return bow_ends(mesh, *bow) if bow else mesh
