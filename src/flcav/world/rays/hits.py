"""First hits of rays: distance, instance and face."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MISS = -1  # instance and face of a ray that hits nothing


class Hits(NamedTuple):
    """The first hit of each of N rays."""

    distance: NDArray[np.float32]  # (N,) range along the unit direction [m]; inf where nothing is hit
    instance: NDArray[np.int32]  # (N,) number of the instance; 0 for a solid alone; MISS where nothing is hit
    face: NDArray[np.int32]  # (N,) row of that solid's faces; MISS where nothing is hit
