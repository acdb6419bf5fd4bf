"""Everything rays can hit at one instant of a traffic run."""

import pickle
import zlib
from collections import OrderedDict
from functools import lru_cache
from hashlib import sha256
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import pose
from flcav.world.materials import PAINT_REFLECTIVITY, REFLECTIVITY, RETRO, Material
from flcav.world.meshes import Mesh, actor_mesh
from flcav.world.rays.embree import Assembly, Embree, Solid
from flcav.world.rays.raycaster import Hits
from flcav.world.static import town_mesh
from flcav.world.town import Town
from flcav.world.trace import Trace


class Surfaces(NamedTuple):
    """What the faces of a scene's instances are like; row `first[instance] + face`."""

    normal: NDArray[np.float32]  # (S, 3) unit, of either sign, body frame
    material: NDArray[np.uint8]  # (S,)
    first: NDArray[np.int64]  # (I,) first row of each instance's mesh
    paint: NDArray[np.float32]  # (I,) reflectivity of its PAINT
    reflectivity: NDArray[np.float32] = REFLECTIVITY  # (M,) by material
    retro: NDArray[np.bool_] = RETRO  # (M,) by material


class Scene:
    """A town and its traffic at one instant; instance 0 is the town, instance a + 1 the trace's actor a."""

    def __init__(self, town: Town, trace: Trace) -> None:
        """Stand at the first instant of `trace`. Meshes are built once per process, whatever the number of scenes."""
        self.town = town
        self.trace = trace
        self.index = 0
        self._hidden: int | None = None
        shapes = [(str(category), int(shape)) for category, shape in zip(trace.category, trace.shape)]
        meshes = [_town(town), *(_actor(*shape) for shape in shapes)]
        self._solids = [solid for _, solid in meshes]
        self._assembly = Assembly(self._solids)
        self._assembly.place(0, np.eye(4))
        self.surfaces = _surfaces([mesh for mesh, _ in meshes], [str(name) for name in trace.actor])
        self.move_to(0)

    def move_to(self, index: int) -> None:
        """Put every actor where it is at instant `index` of the trace."""
        self.index = index
        self._place()

    @property
    def world_from_instance(self) -> NDArray[np.float64]:
        """(I, 3, 3) rotations of the instances; the identity for the town and for absent actors."""
        yaw = np.concatenate(([0.0], np.nan_to_num(self.trace.yaw[self.index])))
        cos, sin, zero, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
        return np.array([[cos, -sin, zero], [sin, cos, zero], [zero, zero, one]]).transpose(2, 0, 1)

    def world_from_actor(self, actor: int) -> NDArray[np.float64]:
        """Return the (4, 4) pose of an actor that is present; its origin is the ground centre."""
        x, y, z = self.trace.position[self.index, actor]
        return pose(x, y, z, float(self.trace.yaw[self.index, actor]))

    def cast(
        self,
        world_from_rays: NDArray[np.float64],
        directions: NDArray[np.float32],
        *,
        near_m: NDArray[np.float32] | None = None,
        far_m: float = np.inf,
        hidden: int | None = None,
    ) -> Hits:
        """Return what each ray (N, 3) meets first, as if the actor `hidden` were not there: see `Target.trace`."""
        if hidden != self._hidden:
            self._hidden = hidden
            self._place()
        return self._assembly.trace(world_from_rays, directions, near_m=near_m, far_m=far_m)

    def cast_alone(
        self,
        actor: int,
        body_from_rays: NDArray[np.float64],
        directions: NDArray[np.float32],
        *,
        near_m: NDArray[np.float32] | None = None,
        far_m: float = np.inf,
    ) -> Hits:
        """Return what each ray meets of one actor in an empty world; rays are placed in the actor's body frame."""
        return self._solids[actor + 1].trace(body_from_rays, directions, near_m=near_m, far_m=far_m)

    def _place(self) -> None:
        for actor, present in enumerate(self.trace.present[self.index]):
            visible = present and actor != self._hidden
            self._assembly.place(actor + 1, self.world_from_actor(actor) if visible else None)
        self._assembly.commit()


def _surfaces(meshes: list[Mesh], names: list[str]) -> Surfaces:
    distinct = {id(mesh): mesh for mesh in meshes}
    starts = np.cumsum([0, *(len(mesh.faces) for mesh in distinct.values())])
    first = dict(zip(distinct, starts))
    paint = [REFLECTIVITY[Material.PAINT]] + [
        PAINT_REFLECTIVITY[zlib.crc32(name.encode()) % len(PAINT_REFLECTIVITY)] for name in names
    ]
    return Surfaces(
        np.concatenate([mesh.normals() for mesh in distinct.values()]),
        np.concatenate([mesh.material for mesh in distinct.values()]),
        np.array([first[id(mesh)] for mesh in meshes], np.int64),
        np.array(paint, np.float32),
    )


@lru_cache(maxsize=64)
def _actor(category: str, shape: int) -> tuple[Mesh, Solid]:
    mesh = actor_mesh(category, shape)
    return mesh, Embree().solid(mesh.vertices, mesh.faces)


_TOWNS: OrderedDict[str, tuple[Mesh, Solid]] = OrderedDict()  # the last few, by content


def _town(town: Town) -> tuple[Mesh, Solid]:
    key = sha256(pickle.dumps(town)).hexdigest()
    if key not in _TOWNS:
        mesh = town_mesh(town)
        _TOWNS[key] = mesh, Embree().solid(mesh.vertices, mesh.faces)
        while len(_TOWNS) > 3:
            _TOWNS.popitem(last=False)
    return _TOWNS[key]
