"""Types of arrays."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # numbers in double precision; shapes and units are told where it is used
