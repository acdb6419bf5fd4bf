"""Rough surfaces under a LiDAR, against Oren and Nayar's integral over facets and Lambert's law."""

import numpy as np
import pytest

from flcav.sensors.lidar.lidar import Lidar, compress_intensity
from flcav.sensors.lidar.returns import compute_oren_nayar


def test_a_smooth_surface_is_lambertian():
    for cosine in (0.05, 0.5, 1.0):
        assert compute_oren_nayar(cosine, 0.0) == pytest.approx(cosine)


def test_a_rough_surface_follows_the_published_equation():
    for angle in np.radians((0, 30, 60, 85)):
        sigma = 0.6
        a, b = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33), 0.45 * sigma**2 / (sigma**2 + 0.09)
        assert compute_oren_nayar(np.cos(angle), sigma) == pytest.approx(
            np.cos(angle) * (a + b * np.sin(angle) * np.tan(angle)), abs=1e-6
        )


def test_a_rough_street_stays_bright_at_grazing_incidence():
    assert compute_oren_nayar(0.05, 0.6) > 5 * compute_oren_nayar(0.05, 0.0)


def test_intensity_is_compressed_and_cut_off_as_asked():
    points = np.zeros((3, 4), np.float32)
    points[:, 3] = 0.01, 0.09, 1.0
    compress_intensity(points, Lidar(intensity_gamma=0.5, intensity_floor=0.15))
    np.testing.assert_allclose(points[:, 3], (0, 0.3, 1), atol=1e-6)
