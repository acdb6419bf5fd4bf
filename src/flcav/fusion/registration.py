"""Registration of LiDAR suites by generalised ICP (small_gicp, extra `fusion`), from an imperfect calibration.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009. Streets stand still and traffic does not, so that the static
background is registered. The first pass takes pairs as far apart as the calibration may be off, the second near ones.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array
from flcav.config import InputError
from flcav.interface.extras import format_install_command

PAIR_M = (3.0, 0.8)  # farthest pair of points, in each pass
CELL_M = 0.3  # clouds are thinned to a point in each cell of this edge


@dataclass(frozen=True)
class Offset:
    """The distance between two poses."""

    position_cm: float
    rotation_deg: float


def register(target: NDArray, source: NDArray, target_from_source: Array) -> Array:
    """Return the (4, 4) pose of the cloud `source` in the frame of `target`, by generalised ICP.

    target (N, >= 3) and source (M, >= 3): x, y, z [m], each in its own frame. target_from_source: where to start, by
    calibration. Raises `InputError` where small_gicp is not installed, or the clouds have no points in common.
    """
    library = import_small_gicp()
    clouds = [np.ascontiguousarray(cloud[:, :3], dtype=np.float64) for cloud in (target, source)]
    found = target_from_source
    for far_m in PAIR_M:
        result = library.align(
            *clouds,
            init_T_target_source=found,
            registration_type="GICP",
            downsampling_resolution=CELL_M,
            max_correspondence_distance=far_m,
            num_threads=1,
        )
        if not result.num_inliers:
            raise InputError(f"registration: no points of the two clouds are within {far_m:g} m of each other")
        found = np.asarray(result.T_target_source)
    return found


def measure_offset(one: Array, other: Array) -> Offset:
    """Return distance and angle between two (4, 4) poses in the same frame."""
    between = np.linalg.inv(one) @ other
    angle = np.arccos(np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1))
    return Offset(100 * float(np.linalg.norm(between[:3, 3])), float(np.degrees(angle)))


def import_small_gicp() -> Any:
    """Return the library small_gicp; raises `InputError` where it is not installed."""
    try:
        import small_gicp
    except ImportError:
        raise InputError(f"registration needs small_gicp, which is in: {format_install_command('fusion')}") from None
    return small_gicp
