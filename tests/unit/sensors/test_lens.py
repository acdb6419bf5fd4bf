import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from flcav.sensors.lens import Lens, compute_pixel_rays, project_optical, unproject


def test_projection_is_a_pinhole_s():
    lens = Lens(width=200, height=100, fx=150.0, fy=140.0, cx=90.0, cy=55.0)
    points = np.random.default_rng(0).uniform((-3, -3, 1), (3, 3, 9), (50, 3))
    matrix = np.array([[150.0, 0, 90], [0, 140, 55], [0, 0, 1]])
    homogeneous = points @ matrix.T
    np.testing.assert_allclose(project_optical(lens, points), homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-9)


def test_field_of_view_is_what_was_asked_for():
    lens = Lens(width=640, height=384, fov_deg=80.0)
    edges = unproject(lens, [(-0.5, 191.5), (639.5, 191.5)])
    np.testing.assert_allclose(np.degrees(np.arctan(edges[:, 0])), (-40, 40), atol=1e-9)
    assert np.isnan(project_optical(lens, [(0.0, 0.0, -1.0)])).all()


@settings(deadline=None, max_examples=50)
@given(st.floats(-0.12, 0.25), st.floats(-0.02, 0.05), st.floats(-0.003, 0.003), st.floats(-0.003, 0.003), st.data())
def test_distortion_round_trip(k1: float, k2: float, p1: float, p2: float, data: st.DataObject):
    lens = Lens(width=640, height=384, fov_deg=75.0, k1=k1, k2=k2, p1=p1, p2=p2)
    pixel = np.array([[data.draw(st.floats(0, 639)), data.draw(st.floats(0, 383))]])
    plane = unproject(lens, pixel)
    np.testing.assert_allclose(project_optical(lens, np.c_[plane, [1.0]] * 7.0), pixel, atol=1e-4)


def test_a_barrel_shows_more_than_a_pinhole():
    straight, barrel = Lens(fov_deg=80.0), Lens(fov_deg=80.0, k1=-0.15)
    assert compute_pixel_rays(barrel)[0, 2] < compute_pixel_rays(straight)[0, 2]
    np.testing.assert_allclose(np.linalg.norm(compute_pixel_rays(barrel), axis=1), 1, atol=1e-6)


def test_a_folded_image_is_refused():
    with pytest.raises(ValidationError, match="folds"):
        Lens(fov_deg=120.0, k1=-0.6)
