"""Scenes for ray casting: the static mesh of a town and the meshes of its actors at one instant of a trace."""

import zlib
from collections.abc import Mapping
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Array32, Bytes, Ints, Mask
from flcav.geometry import pose, rotations, rotations_about_z
from flcav.world.map.town import Town
from flcav.world.materials import PAINT_REFLECTIVITY, REFLECTIVITY, RETRO, Material
from flcav.world.meshes import Mesh, actor_mesh
from flcav.world.rays.embree import Assembly, Solid, check_embree, trace_each
from flcav.world.rays.packets import Hits
from flcav.world.static import SignsAndSignals, TownCache, build_town_mesh, list_signs_and_signals
from flcav.world.trace import Trace

OFFSET_S = 0.1  # largest extrapolation from an instant of the trace: one step of the traffic


class Surfaces(NamedTuple):
    """Normals and materials of the S faces of a scene's meshes; a hit's row is `first[instance] + face`.

    There are I instances and M materials; instances of the same shape share their rows.
    """

    normal: Array32  # (S, 3) unit normals, of either sign, body frame
    material: Bytes  # (S,) a `Material`
    first: Ints  # (I,) first row of the instance's mesh
    reflectivity: Array32  # (I, M) diffuse reflectance at 905 nm, by material: actors differ in their paint
    retro: Mask = RETRO  # (M,) retroreflectors


class Scene:
    """A town and its traffic at one instant; instance 0 is the town, instance a + 1 the trace's actor a."""

    def __init__(self, town: Town, trace: Trace) -> None:
        """Start at the first instant of `trace`. Meshes are cached for all scenes of the process.

        Raises `OSError` where the ray casting library is missing.
        """
        self.town = town
        self.paints: Mapping[str, tuple[float, float, float]] = {}  # linear RGB by actor; others are painted by name
        check_embree()
        self._town_model = _TOWNS.get(town, lambda: _model(build_town_mesh(town)))
        self._cast(trace)

    def follow(self, trace: Trace) -> None:
        """Move to the first instant of another trace in the same town, which may have other actors.

        If the actors are the same, only their poses are changed: so a scene can follow the snapshots of a live world.
        """
        same = all(
            np.array_equal(getattr(trace, name), getattr(self.trace, name))
            for name in ("actor", "category", "shape", "size", "bow")
        )
        if not same:
            self._cast(trace)
            return
        self.trace, self.index, self.offset_s, self._hidden = trace, 0, 0.0, None
        self._place()

    def _cast(self, trace: Trace) -> None:
        """Create the instances of a trace's actors, and move to its first instant."""
        self.trace, self.index, self.offset_s = trace, 0, 0.0
        models = [self._town_model, *(_actor_model(*trace.model(actor)) for actor in range(len(trace.actor)))]
        self.surfaces = _surfaces(models, [str(name) for name in trace.actor])
        self._solids = [model.solid for model in models]
        self._assembly = Assembly(self._solids)
        self._assembly.place(0, np.eye(4))
        # x, y, z, yaw, pitch, roll; NaN where an actor is not placed
        self._placed = np.full((len(trace.actor), 6), np.nan)
        self._hidden: int | None = None
        self._place()

    @property
    def town_solid(self) -> Solid:
        """The bounding volume hierarchy of the town, which all scenes of the town share."""
        return self._town_model.solid

    @cached_property
    def things(self) -> SignsAndSignals:
        """The town's signs and signal heads."""
        return list_signs_and_signals(self.town)

    def move_to(self, index: int, offset_s: float = 0.0) -> None:
        """Move all actors to their poses at instant `index` of the trace, or `offset_s` [s] later.

        Poses off an instant are extrapolated with constant acceleration and yaw rate. Raises `ValueError` where
        `offset_s` is not within -`OFFSET_S` and `OFFSET_S`.
        """
        if abs(offset_s) > OFFSET_S:
            raise ValueError(f"offset_s = {offset_s}: must lie within -{OFFSET_S} and {OFFSET_S}")
        if (index, offset_s) != (self.index, self.offset_s):
            self.index, self.offset_s = index, offset_s
            self._place()

    def poses(self) -> Array:
        """Return x, y, z [m] and yaw [rad] of the actors at the scene's time (A, 4), world frame; NaN where absent."""
        trace, i, dt = self.trace, self.index, self.offset_s
        position = trace.position[i]
        yaw = trace.yaw[i]
        if dt:
            position = position + dt * trace.velocity[i] + dt**2 / 2 * trace.acceleration[i]
            yaw = yaw + dt * trace.yaw_rate[i]
        return np.concatenate((position, yaw[:, None]), axis=1)

    def world_from_actor(self, actor: int) -> Array:
        """Return the pose (4, 4) [m] of a present actor, world frame.

        The origin of its body frame is its ground centre.
        """
        return pose(*self.poses()[actor], *self.trace.tilts(self.index)[actor])

    def world_from_instance(self) -> Array:
        """Return the rotation matrices of the instances (I, 3, 3); the identity for the town and for absent actors."""
        return np.concatenate((np.eye(3)[None], self.rotations()))

    def rotations(self) -> Array:
        """Return the rotation matrices of the actors' body frames (A, 3, 3); the identity for absent actors."""
        yaw = np.nan_to_num(self.poses()[:, 3])
        if self.trace.tilt is None:
            return rotations_about_z(yaw)
        return rotations(yaw, *np.nan_to_num(self.trace.tilts(self.index)).T)

    def cast(
        self,
        world_from_rays: Array,
        directions: Array32,
        *,
        near_m: Array32 | None = None,
        far_m: float = np.inf,
        hidden: int | None = None,
        threads: int = 1,
    ) -> Hits:
        """Return the first hits of unit rays (N, 3), without the actor `hidden`: see `embree.Hierarchy.trace`.

        `world_from_rays` (4, 4) [m] is the pose of the frame of the rays, which start at its origin.
        """
        self._hide(hidden)
        return self._assembly.trace(world_from_rays, directions, near_m=near_m, far_m=far_m, threads=threads)

    def find_occluded(
        self, origins: Array32, directions: Array32, far_m: Array32, *, hidden: int | None = None, threads: int = 1
    ) -> Mask:
        """Return (N,) whether rays are occluded before their ends `far_m` (N,) [m], ignoring the actor `hidden`.

        `origins` (N, 3) [m] and unit `directions` (N, 3), or (1, 3) for all, are in the world frame. A ray with a
        `far_m` that is not positive is never occluded.
        """
        self._hide(hidden)
        return self._assembly.find_occluded(origins, directions, far_m, threads=threads)

    def cast_each(
        self,
        actors: Ints,
        body_from_rays: Array,
        ends: Ints,
        directions: Array32,
        *,
        near_m: Array32 | None = None,
        far_m: float = np.inf,
    ) -> Hits:
        """Return the first hits of K groups of rays, group k only with the mesh of `actors[k]`.

        `instance` is the group index. Group k is `directions[ends[k - 1] : ends[k]]`: unit vectors in a frame whose
        pose in the actor's body frame is `body_from_rays[k]` (4, 4) [m].
        """
        solids = [self._solids[actor + 1] for actor in actors.tolist()]
        return trace_each(solids, body_from_rays, ends, directions, near_m=near_m, far_m=far_m)

    def _hide(self, hidden: int | None) -> None:
        if hidden != self._hidden:
            self._hidden = hidden
            self._place()

    def _place(self) -> None:
        """Update the instances of actors that have moved since the last call, and remove absent and hidden ones."""
        poses = np.concatenate((self.poses(), self.trace.tilts(self.index)), axis=1)
        wanted = np.where(self.trace.present[self.index, :, None], poses, np.nan)
        if self._hidden is not None:
            wanted[self._hidden] = np.nan
        same = (wanted == self._placed) | np.isnan(wanted) & np.isnan(self._placed)
        moved = np.flatnonzero(~same.all(axis=1))
        nowhere = set(moved[np.isnan(wanted[moved, 0])].tolist())
        world_from_actor = np.tile(np.eye(4), (len(moved), 1, 1))
        world_from_actor[:, :3, :3] = self.rotations()[moved]
        world_from_actor[:, :3, 3] = wanted[moved, :3]
        for actor, matrix in zip(moved.tolist(), world_from_actor):
            self._assembly.place(actor + 1, None if actor in nowhere else matrix)
        self._placed = wanted
        self._assembly.commit()


class _Model(NamedTuple):
    """A mesh with its normals and its bounding volume hierarchy."""

    mesh: Mesh
    normal: Array32
    solid: Solid


def _model(mesh: Mesh) -> _Model:
    return _Model(mesh, mesh.normals(), Solid(mesh.vertices, mesh.faces))


def _surfaces(models: list[_Model], names: list[str]) -> Surfaces:
    """Return the faces of all distinct models; an actor's paint is chosen by a hash of its name."""
    distinct = {id(model): model for model in models}
    starts = np.cumsum([0, *(len(model.mesh.faces) for model in distinct.values())])
    first = dict(zip(distinct, starts))
    reflectivity = np.tile(REFLECTIVITY, (len(models), 1))
    paints = [zlib.crc32(name.encode()) % len(PAINT_REFLECTIVITY) for name in names]
    reflectivity[1:, Material.PAINT] = PAINT_REFLECTIVITY[np.array(paints, np.int64)]
    return Surfaces(
        np.concatenate([model.normal for model in distinct.values()]),
        np.concatenate([model.mesh.material for model in distinct.values()]),
        np.array([first[id(model)] for model in models], np.int64),
        reflectivity,
    )


@lru_cache(maxsize=256)
def _actor_model(category: str, shape: int, size: tuple[float, ...]) -> _Model:
    return _model(actor_mesh(category, shape, size))


_TOWNS = TownCache[_Model]()
