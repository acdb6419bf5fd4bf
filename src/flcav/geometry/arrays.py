"""Types of arrays."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # double precision; shape, unit and frame are stated at each use
