"""What several tests of networks look at."""

import numpy as np
import pytest

from flcav.geometry import Boxes
from flcav.perception.objects import Sample


@pytest.fixture
def sample():
    """Return a sweep of scattered points with one car."""
    rng = np.random.default_rng(0)
    points = rng.uniform((0, -20, -2, 0), (40, 20, 0, 1), size=(4000, 4)).astype(np.float32)
    car = Boxes(np.array([[12.0, 3.0, -1.0]]), np.array([[4.4, 1.8, 1.6]]), np.array([0.3]), np.array(["Car"]))
    return Sample(points, car)
