from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely
from scipy.ndimage import label
from shapely.geometry import MultiPolygon, Point, Polygon

from flcav.geometry import pose
from flcav.machine import threads
from flcav.sensors.camera import Camera, develop, grain, photograph
from flcav.sensors.frame import SEMANTICS
from flcav.sensors.lens import BODY_FROM_OPTICAL, Lens, compute_pixel_rays
from flcav.sensors.rendering import render
from flcav.sensors.rendering.appearance import build_appearance
from flcav.sensors.rendering.gbuffer import fill_gbuffer
from flcav.sensors.rendering.ground import build_markings, sample_paint
from flcav.sensors.rendering.light import DARKEST, compute_ambient_occlusion, compute_light
from flcav.sensors.rendering.rain import add_drops, add_sun_glare
from flcav.world.map.layers import Arrow, Crossing, MapLayers, Marking, outline_paint
from flcav.world.map.town import Town
from flcav.world.scene import Scene
from flcav.world.trace import Trace
from flcav.world.weather import WEATHERS, Weather

AHEAD = pose(0.0, 0.0, 1.5) @ BODY_FROM_OPTICAL
WALL = np.array([[20.0, 12.0, 0.0, 60.0, 4.0, 12.0]])  # beside the road, its face on y = 10


@pytest.fixture(scope="module")
def street(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    cars = [("veh0", "car", 3, 14.0, -1.5, 0.3), ("ped0", "pedestrian", 0, 9.0, 2.0, 1.0)]
    trees, lamps = np.array([[25.0, 8.0, 6.0, 1.8]]), np.array([[40.0, -8.0, 7.0]])
    return Scene(small_town(buildings=WALL, trees=trees, lamps=lamps), standing(cars))


def test_further_rays_may_take_what_pixels_beside_them_show(street: Scene, monkeypatch: pytest.MonkeyPatch):
    """Against shading every further ray."""

    def shot() -> np.ndarray:
        camera = Camera(width=320, height=192, noise=0)
        return photograph(street, AHEAD, camera, WEATHERS["clear"], np.random.default_rng(0)).rgb.astype(int)

    quick = shot()
    monkeypatch.setattr(render, "donors", lambda *arguments: arguments[-1].fill(-1))
    difference = np.abs(quick - shot()).max(axis=2)
    assert difference.max() > 0
    assert difference.mean() < 0.3
    assert (difference > 24).mean() < 0.004


def test_what_is_painted_is_what_the_map_says():
    layers = MapLayers(
        roads=(),
        sidewalks=(),
        lanes=(),
        markings=(
            Marking("solid", np.array([[0.0, 0.0], [20.0, 3.0]]), 0.12, 0.0, 0.0),
            Marking("dashed", np.array([[0.0, 5.0], [20.0, 5.0]]), 0.15, 3.0, 3.0),
        ),
        crossings=(
            Crossing("a", np.array([[5.0, -8], [9, -8], [9, -2], [5, -2]]), np.array([[7.0, -8], [7, -2]]), 4.0),
        ),
        arrows=(Arrow("straight_left", 12.0, -5.0, 0.7, ""), Arrow("right", 16.0, -3.0, -2.0, "")),
    )
    markings = build_markings(layers)
    shapes = shapely.union_all([Polygon(paint.outline) for paint in outline_paint(layers)])
    assert isinstance(shapes, MultiPolygon)
    rng, narrow, found = np.random.default_rng(0), np.float32(1e-4), 0
    for x, y in rng.uniform((-1, -9), (21, 6), (2500, 2)):
        if shapes.boundary.distance(Point(x, y)) > 0.07:  # arrows are strips
            share, _ = sample_paint(x, y, np.float32(1), np.float32(0), narrow, narrow, markings)
            assert share == shapes.contains(Point(x, y))
            found += share
    assert found > 40


def test_half_the_sky_is_free_at_the_foot_of_a_wall(street: Scene):
    lens = Lens(width=64, height=64, fov_deg=2.0)
    sees = []
    for y in (9.9, 4.0):
        at = pose(20.0, y, 2.0, 0.0, np.pi / 2) @ BODY_FROM_OPTICAL
        hits = street.cast(at, compute_pixel_rays(lens))
        seen = fill_gbuffer(street, build_appearance(street), at, compute_pixel_rays(lens), hits)
        sees.append(compute_ambient_occlusion(street, seen, lens, None).reshape(64, 64)[24:40, 24:40].mean())
    assert sees[0] == pytest.approx(DARKEST + (1 - DARKEST) / 2, abs=0.08)
    assert sees[1] == 1.0


def test_the_sun_dazzles_only_where_it_is_in_sight(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    low = Weather(sun_elevation_deg=5.0, sun_azimuth_deg=90.0, cloud_cover=0.0)
    walled = small_town(buildings=np.array([[30.0, 0.0, 0.0, 8.0, 30.0, 15.0]]))
    lens, added = Lens(width=160, height=96), []
    for town in (small_town(), walled):
        image = np.zeros((96, 160, 3), np.float32)
        add_sun_glare(image, Scene(town, standing([])), compute_light(low), AHEAD, lens, None)
        added.append(image[..., 0])
    row, column = np.unravel_index(added[0].argmax(), added[0].shape)
    assert column == pytest.approx(79.5, abs=1)
    assert row == pytest.approx(47.5 - 80 * np.tan(np.radians(5)), abs=1)
    assert added[0].min() > 0
    assert not added[1].any()


def test_a_drop_on_the_lens_shows_the_scene_upside_down():
    image = np.tile(np.linspace(1.0, 0.0, 384, dtype=np.float32)[:, None, None], (1, 640, 3))
    wet = image.copy()
    add_drops(wet, 30.0, np.random.default_rng(1))
    changed = np.abs(wet - image).max(axis=2) > 1e-6
    assert 0.001 < changed.mean() < 0.1
    found: Any = label(changed)
    regions = found[0]
    largest = np.bincount(regions.ravel())[1:].argmax() + 1
    rows, columns = np.nonzero(regions == largest)
    middle = np.abs(columns - columns.mean()) < 2
    centre = np.abs(rows - rows.mean()) < np.ptp(rows) / 4
    kept = middle & centre
    assert np.polyfit(rows[kept], wet[rows[kept], columns[kept], 0], 1)[0] > 0  # the image itself falls


def test_brightness_rises_and_walls_in_the_sun_are_not_burnt_out():
    light = np.repeat(np.geomspace(1e-3, 20, 400, dtype=np.float32)[:, None], 3, axis=1)
    out = np.empty((400, 3), np.uint8)
    develop(light, np.float32(1), grain(), 0, np.float32(0), out)
    assert (np.diff(out[:, 0].astype(int)) >= 0).all()
    at = dict(zip((0.01, 0.15, 1.5, 6.0), np.interp((0.01, 0.15, 1.5, 6.0), light[:, 0], out[:, 0])))
    assert at[0.01] < 30
    assert 95 < at[0.15] < 130
    assert 215 < at[1.5] < 245
    assert at[6.0] > 253


@pytest.mark.parametrize(("library", "calls"), [("glibc", 2), ("", 0)])
def test_memory_is_kept_only_where_the_library_can(monkeypatch: pytest.MonkeyPatch, library: str, calls: int):
    set_to: list[tuple[int, int]] = []
    monkeypatch.setattr(threads.platform, "libc_ver", lambda: (library, ""))
    monkeypatch.setattr(threads.ctypes, "CDLL", lambda name: SimpleNamespace(mallopt=lambda *pair: set_to.append(pair)))
    threads.keep_freed_memory.__wrapped__()
    assert len(set_to) == calls
    assert all(size in (threads.KEPT_BYTES, threads.LARGEST_BYTES) for _, size in set_to)


def test_the_fine_look_darkens_kerbs_dulls_grass_and_has_a_skyline_and_the_labels_stay(street: Scene):
    """Against the look `plain`, by the classes of its pixels."""
    shots = {}
    for look in ("plain", "fine"):
        camera = Camera(width=320, height=192, noise=0, look=look)
        shots[look] = photograph(street, AHEAD, camera, WEATHERS["overcast"], np.random.default_rng(0))
    plain, fine = shots["plain"], shots["fine"]
    assert (plain.semantic == fine.semantic).all()
    assert (plain.instance == fine.instance).all()
    grass, sky = plain.semantic == SEMANTICS["terrain"], plain.semantic == SEMANTICS["sky"]
    colourful = {look: np.ptp(shot.rgb[grass].astype(int), axis=1).mean() for look, shot in shots.items()}
    assert colourful["fine"] < 0.8 * colourful["plain"]
    sidewalk = plain.semantic == SEMANTICS["sidewalk"]
    darker = fine.rgb[sidewalk].mean(axis=1) / plain.rgb[sidewalk].mean(axis=1)
    kerb = darker < 0.95
    assert 0.05 < kerb.mean() < 0.6
    assert np.median(darker[kerb]) < 0.85
    assert (darker[~kerb] > 0.99).mean() > 0.95
    other = np.abs(plain.rgb.astype(int) - fine.rgb).max(axis=2) > 2
    rows = np.flatnonzero((other & sky).any(axis=1))
    assert len(rows)
    horizon = 95.5 - 160 * np.tan(np.radians(4.0))
    assert rows.min() > horizon  # houses and hills are low, and clouds as they were
    walls = plain.semantic == SEMANTICS["building"]
    assert walls.any()
    assert not np.median(
        np.abs(plain.rgb.astype(int) - fine.rgb)[walls]
    )  # only window panes differ: they mirror clouds
