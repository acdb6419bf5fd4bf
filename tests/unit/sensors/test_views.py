"""Labels in images, against brute force and shapely."""

from collections.abc import Callable

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.geometry import inverse, pose, transform_points
from flcav.sensors.lens import BODY_FROM_OPTICAL, Lens, compute_pixel_rays, project_optical
from flcav.sensors.views import (
    clip_boxes,
    compute_amodal_boxes,
    find_actor_regions,
    find_thing_regions,
    hull,
    view_actors,
)
from flcav.world.map.town import Town
from flcav.world.meshes import actor_mesh
from flcav.world.scene import Scene
from flcav.world.shapes import SHAPES
from flcav.world.trace import Trace

LENS = Lens(width=160, height=96, fov_deg=80.0)
EVERY_SHAPE = [(category, index) for category in SHAPES for index in range(len(SHAPES[category]))]


def camera(x: float = 0.0, y: float = 0.0, z: float = 1.5, yaw: float = 0.0) -> np.ndarray:
    return pose(x, y, z, yaw) @ BODY_FROM_OPTICAL


def picture(scene: Scene, at: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    """Return the instance image by bare tracing."""
    hits = scene.cast(at, compute_pixel_rays(lens))
    return np.maximum(hits.instance, 0).reshape(lens.height, lens.width)


@pytest.mark.parametrize("pair", EVERY_SHAPE[::3], ids=str)
def test_a_hull_holds_its_mesh_and_has_its_corners(pair: tuple[str, int]):
    found, mesh = hull(*pair), actor_mesh(*pair).vertices.astype(np.float64)
    assert len(found.vertices) < len(mesh)
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(50, 3)):
        assert (found.vertices @ direction).max() == pytest.approx((mesh @ direction).max())
    neighbours = shapely.MultiPoint(found.vertices[:, :2]).convex_hull.area
    assert neighbours == pytest.approx(shapely.MultiPoint(mesh[:, :2]).convex_hull.area)
    assert len(found.edges) <= 3 * len(found.vertices) - 6  # Euler


@given(
    pair=st.sampled_from(EVERY_SHAPE),
    distance=st.floats(4.0, 40.0),
    aside=st.floats(-0.6, 0.6),
    yaw=st.floats(-np.pi, np.pi),
    k1=st.sampled_from([0.0, -0.1]),
)
@settings(max_examples=40, deadline=None)
def test_amodal_boxes_are_around_every_vertex(
    small_town: Callable[..., Town],
    standing: Callable[..., Trace],
    pair: tuple[str, int],
    distance: float,
    aside: float,
    yaw: float,
    k1: float,
):
    lens, at = Lens(width=160, height=96, fov_deg=80.0, k1=k1), camera()
    scene = Scene(small_town(), standing([("it", *pair, distance, aside * distance, yaw)]))
    box = compute_amodal_boxes(scene, at, lens, np.array([0]))[0]
    points = transform_points(inverse(at) @ scene.world_from_actor(0), actor_mesh(*pair).vertices.astype(np.float64))
    if points[:, 2].min() < 0.1:
        return
    pixels = project_optical(lens, points)
    expected = np.concatenate((pixels.min(axis=0), pixels.max(axis=0)))
    if (expected[:2] < (lens.width - 0.5, lens.height - 0.5)).all() and (expected[2:] > -0.5).all():
        if k1 == 0:
            np.testing.assert_allclose(box, expected, atol=1e-6)
        elif (np.abs(points[:, 0]) < points[:, 2]).all():  # where the lens is trusted
            np.testing.assert_allclose(*clip_boxes(np.stack((box, expected)), lens), atol=1.0)
    else:
        assert np.isnan(box).all()


def test_an_actor_that_passes_the_camera_is_cut_at_it(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    """A bus beside the camera reaches from behind it to ahead: its rectangle goes on to the image's edge and beyond."""
    scene = Scene(small_town(), standing([("it", "bus", 0, 1.0, 2.5, 0.0)]))
    box = compute_amodal_boxes(scene, camera(), LENS, np.array([0]))[0]
    assert box[0] < -0.5
    assert box[2] < LENS.width / 2
    seen = picture(scene, camera()) == 1
    v, u = np.nonzero(seen)
    assert len(v) > 200
    assert (u >= box[0]).all()
    assert (u <= box[2]).all()
    assert (v >= box[1]).all()
    assert (v <= box[3]).all()
    behind = compute_amodal_boxes(scene, camera(x=20.0), LENS, np.array([0]))[0]
    assert np.isnan(behind).all()


def test_occlusion_and_truncation_of_a_row_of_cars(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    cars = [("a", "car", 0, 10.0, 0.0, 0.0), ("b", "van", 1, 18.0, 0.6, 0.0), ("c", "car", 2, 8.0, 6.3, 0.0)]
    scene, at = Scene(small_town(), standing(cars)), camera()
    instance = picture(scene, at)
    views = view_actors(scene, at, LENS, instance, find_actor_regions(instance, 3), np.arange(3))
    for actor in range(3):
        alone = picture(Scene(small_town(), standing([cars[actor]])), at) == 1
        shown = np.count_nonzero(instance == actor + 1)
        assert views.pixels[actor] == shown
        assert views.occlusion[actor] == pytest.approx(1 - shown / np.count_nonzero(alone), abs=1e-9)
        v, u = np.nonzero(instance == actor + 1)
        np.testing.assert_array_equal(
            views.visible_box[actor], (u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5)
        )
        whole = shapely.box(*views.amodal_box[actor])
        inside = whole.intersection(shapely.box(-0.5, -0.5, LENS.width - 0.5, LENS.height - 0.5))
        assert views.truncation[actor] == pytest.approx(1 - inside.area / whole.area)
    assert views.occlusion[0] < 0.01 < 0.3 < views.occlusion[1] < 1
    assert views.truncation[0] == 0 < views.truncation[2] < 1


def test_a_large_actor_is_judged_by_some_of_its_pixels(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    lens = Lens(width=640, height=384, fov_deg=80.0)
    cars = [("a", "pedestrian", 0, 3.0, 0.0, 0.0), ("b", "bus", 0, 11.0, 0.0, 1.2)]
    scene, at = Scene(small_town(), standing(cars)), camera()
    instance = picture(scene, at, lens)
    views = view_actors(scene, at, lens, instance, find_actor_regions(instance, 2), np.arange(2))
    alone = np.count_nonzero(picture(Scene(small_town(), standing(cars[1:])), at, lens) == 1)
    assert alone > 20_000
    assert views.occlusion[1] == pytest.approx(1 - views.pixels[1] / alone, abs=0.02)


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_regions_are_those_of_a_mask(seed: int):
    rng = np.random.default_rng(seed)
    image = rng.choice([0, 0, 0, 1, 2, -1, -3], size=(7, 9)).astype(np.int32)
    for regions, sign in ((find_actor_regions(image, 3), 1), (find_thing_regions(image, 3), -1)):
        for i in range(3):
            v, u = np.nonzero(image == sign * (i + 1))
            assert regions.pixels[i] == len(v)
            if len(v):
                np.testing.assert_array_equal(
                    regions.box[i], (u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5)
                )
            else:
                assert np.isnan(regions.box[i]).all()
