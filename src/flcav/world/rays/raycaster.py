"""Interface of a ray casting engine: meshes with an acceleration structure, and assemblies of placed instances."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

MISS = -1  # instance and face of a ray that hits nothing


class Hits(NamedTuple):
    """The first hit of each of N rays."""

    distance: NDArray[np.float32]  # (N,) range along the unit direction [m]; inf where nothing is hit
    instance: NDArray[np.int32]  # (N,) number of the instance; 0 for a solid alone; MISS where nothing is hit
    face: NDArray[np.int32]  # (N,) row of that solid's faces; MISS where nothing is hit


class Target(Protocol):
    """Geometry that rays can be traced against: one mesh or an assembly."""

    def trace(
        self,
        target_from_rays: NDArray[np.float64],
        directions: NDArray[np.float32],
        *,
        near_m: NDArray[np.float32] | None = None,
        far_m: float = np.inf,
        threads: int = 1,
    ) -> Hits:
        """Return the first hit of each ray beyond `near_m` (N,) [m], by default 0, and before `far_m` [m].

        All rays start at the origin of one frame: `target_from_rays` (4, 4) is its pose in the target's frame,
        `directions` (N, 3) are unit vectors in it. Raises `ValueError` where `near_m` is not of the rays' number.
        """
        ...


class Assembly(Target, Protocol):
    """Instances of solids, placed by rigid transforms; placing one again rebuilds no mesh."""

    def place(self, instance: int, target_from_body: NDArray[np.float64] | None) -> None:
        """Place an instance by a (4, 4) rigid transform, or remove it (None); takes effect with `commit`."""
        ...

    def commit(self) -> None:
        """Apply all placements since the last commit. Not to be called while another thread traces."""
        ...

    def find_occluded(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32], far_m: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Return (N,) whether each ray is occluded before its end `far_m` (N,) [m]; never where that is not positive.

        `origins` (N, 3) [m] and unit `directions` (N, 3), or (1, 3) for all, are in the assembly's frame.
        """
        ...


SolidT = TypeVar("SolidT", bound=Target)


class Raycaster(Protocol[SolidT]):
    """A ray casting engine, generic in its type of solid."""

    def solid(self, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> SolidT:
        """Return the mesh of vertices (V, 3) [m] and faces (F, 3) with its acceleration structure."""
        ...

    def assembly(self, solids: Sequence[SolidT]) -> Assembly:
        """Return an assembly of `solids`, none placed yet; instance i is of solid i."""
        ...

    def trace_each(
        self,
        solids: Sequence[SolidT],
        solid_from_rays: NDArray[np.float64],
        ends: NDArray[np.int64],
        directions: NDArray[np.float32],
        *,
        near_m: NDArray[np.float32] | None = None,
        far_m: float = np.inf,
    ) -> Hits:
        """Return the first hits of K groups of rays, group k with `solids[k]` alone; `instance` is the group's number.

        Group k is `directions[ends[k - 1] : ends[k]]`: unit vectors in a frame whose pose in its solid's frame is
        `solid_from_rays[k]` (4, 4). `near_m` and `far_m` are as in `Target.trace`.
        """
        ...
