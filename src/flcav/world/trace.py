"""A traffic run as one immutable table: who was where, when."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CATEGORIES = ("car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian")


@dataclass(frozen=True)
class Trace:
    """T instants of A actors; an actor's pose is its ground centre, world frame."""

    town: str
    time_s: Array  # (T,)
    actor: NDArray[np.str_]  # (A,) track ids, e.g. "cav0", "veh17", "parked3", "ped8"
    category: NDArray[np.str_]  # (A,) one of CATEGORIES
    shape: NDArray[np.int64]  # (A,) index of the mesh variant within the category
    size: Array  # (A, 3) length, width, height [m]
    present: NDArray[np.bool_]  # (T, A)
    position: Array  # (T, A, 3) ground centre [m]; NaN where absent
    yaw: Array  # (T, A) [rad]; NaN where absent
    velocity: Array  # (T, A, 3) [m/s]; NaN where absent
    light: NDArray[np.str_]  # (L,) traffic light ids (junction:link index)
    light_state: NDArray[np.str_]  # (T, L) one SUMO state letter: G g y r ...

    def save(self, path: Path) -> None:
        """Write the trace as one Parquet file."""
        raise NotImplementedError

    @classmethod
    def load(cls, path: Path) -> "Trace":
        """Read a trace that `save` wrote."""
        raise NotImplementedError
