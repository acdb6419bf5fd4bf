"""What the sensors ask of a ray casting engine: meshes to search, and assemblies of placed meshes."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

MISS = -1


class Hits(NamedTuple):
    """The first surface each of N rays meets."""

    distance: NDArray[np.float32]  # (N,) [m] along the unit direction; inf where nothing is met
    instance: NDArray[np.int32]  # (N,) number of the placed solid; 0 for a solid alone; MISS
    face: NDArray[np.int32]  # (N,) row of that solid's faces; MISS


class Target(Protocol):
    """Something rays can be traced against."""

    def trace(
        self,
        target_from_rays: NDArray[np.float64],
        directions: NDArray[np.float32],
        *,
        near_m: NDArray[np.float32] | None = None,
        far_m: float = np.inf,
        threads: int = 1,
    ) -> Hits:
        """Return the first hit of each ray beyond `near_m` (N,) and before `far_m`.

        All rays leave the origin of one frame: `target_from_rays` (4, 4) places it, `directions` (N, 3) are unit
        vectors in it.
        """
        ...


class Assembly(Target, Protocol):
    """Solids placed by rigid transforms; placing one again rebuilds no mesh."""

    def place(self, instance: int, target_from_body: NDArray[np.float64] | None) -> None:
        """Put a solid at a (4, 4) transform, or nowhere (None); takes effect with `commit`."""
        ...

    def commit(self) -> None:
        """Make what was placed visible to the next trace. Never while another thread traces."""
        ...

    def blocked(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32], far_m: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Return for each ray whether anything lies before its end `far_m` (N,); never where that is not positive.

        `origins` (N, 3) and unit `directions` (N, 3), or (1, 3) for all, are in the assembly's frame.
        """
        ...


SolidT = TypeVar("SolidT", bound=Target)


class Raycaster(Protocol[SolidT]):
    """An engine, and its own kind of solid."""

    def solid(self, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> SolidT:
        """Return a mesh, (V, 3) [m] and (F, 3), with its search structure."""
        ...

    def assembly(self, solids: Sequence[SolidT]) -> Assembly:
        """Return an assembly of `solids`, none placed yet; instance i is solid i."""
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
        """Return what groups of rays meet first, each of one of K `solids` alone; `instance` is the group's number.

        Group k is `directions[ends[k - 1] : ends[k]]`, unit vectors of a frame that `solid_from_rays` (K, 4, 4) places.
        """
        ...
