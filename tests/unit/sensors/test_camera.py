from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Delaunay

from flcav.geometry import inverse, pose, transform_points
from flcav.sensors.camera import Camera, Exposure, label, photograph
from flcav.sensors.frame import SEMANTICS
from flcav.sensors.infrared import Infrared, render_thermal
from flcav.sensors.lens import BODY_FROM_OPTICAL, compute_pixel_rays, project_optical
from flcav.sensors.rendering.render import render_radiance
from flcav.world.map.signals import Signals
from flcav.world.map.town import Signs, Town
from flcav.world.meshes import actor_mesh
from flcav.world.scene import Scene
from flcav.world.trace import Trace
from flcav.world.weather import WEATHERS, Weather

AHEAD = pose(0.0, 0.0, 1.5) @ BODY_FROM_OPTICAL
CLEAR = WEATHERS["clear"]


def shot(scene: Scene, weather: Weather = CLEAR, at: np.ndarray = AHEAD, camera: Camera | None = None) -> Exposure:
    return photograph(scene, at, camera or Camera(width=320, height=192, noise=0), weather, np.random.default_rng(0))


@pytest.fixture(scope="module")
def street(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    buildings = np.array([[30.0, 20.0, 0.0, 30.0, 10.0, 12.0]])
    cars = [("veh0", "car", 3, 14.0, -1.5, 0.3), ("ped0", "pedestrian", 0, 9.0, 2.0, 1.0)]
    return Scene(small_town(buildings=buildings), standing(cars))


def test_depth_is_that_of_the_rays(street: Scene):
    camera = Camera(width=320, height=192, k1=-0.1, noise=0)
    rays = compute_pixel_rays(camera)
    hits = street.cast(AHEAD, rays, far_m=1000.0)
    depth = shot(street, camera=camera).depth_m
    np.testing.assert_allclose(depth.ravel(), hits.distance * rays[:, 2], rtol=1e-6)
    assert np.isinf(depth).any()


def test_an_instance_lies_within_the_hull_of_its_mesh(street: Scene):
    camera = Camera(width=320, height=192, noise=0)
    picture = shot(street, camera=camera)
    body = street.world_from_actor(0)
    vertices = transform_points(inverse(AHEAD) @ body, actor_mesh("car", 3).vertices.astype(np.float64))
    rows, columns = np.nonzero(picture.instance == 1)
    assert len(rows) > 300
    assert (Delaunay(project_optical(camera, vertices)).find_simplex(np.c_[columns, rows]) >= 0).all()
    assert set(np.unique(picture.semantic[picture.instance == 1])) == {SEMANTICS["car"]}
    assert (picture.semantic[np.isinf(picture.depth_m)] == SEMANTICS["sky"]).all()


@pytest.mark.parametrize("hidden", [None, 0])
def test_labels_alone_are_those_of_the_photograph(street: Scene, hidden: int | None):
    camera = Camera(width=320, height=192, noise=0)
    semantic, instance = label(street, AHEAD, camera, hidden=hidden, threads=2)
    picture = photograph(street, AHEAD, camera, CLEAR, np.random.default_rng(0), hidden=hidden)
    np.testing.assert_array_equal(semantic, picture.semantic)
    np.testing.assert_array_equal(instance, picture.instance)


def test_same_arguments_same_bytes(street: Scene):
    rain = WEATHERS["heavy_rain"]
    camera = Camera(width=160, height=96)
    one, other = (photograph(street, AHEAD, camera, rain, np.random.default_rng(3)) for _ in range(2))
    shared = photograph(street, AHEAD, camera, rain, np.random.default_rng(3), threads=3)
    different = photograph(street, AHEAD, camera, rain, np.random.default_rng(4))
    assert one.rgb.tobytes() == other.rgb.tobytes() == shared.rgb.tobytes()
    assert one.rgb.tobytes() != different.rgb.tobytes()


def test_a_car_throws_a_shadow_where_its_rays_to_the_sun_end(street: Scene):
    weather = Weather(sun_elevation_deg=35.0, sun_azimuth_deg=0.0, cloud_cover=0.0)
    picture = shot(street, weather)
    on_road = picture.semantic == SEMANTICS["road"]
    camera = Camera(width=320, height=192, noise=0)
    rows, columns = np.nonzero(on_road)
    local = compute_pixel_rays(camera).reshape(192, 320, 3)[rows, columns]
    points = transform_points(AHEAD, local / local[:, 2:] * picture.depth_m[rows, columns, None])
    to_sun = np.array([[0.0, np.cos(np.radians(35)), np.sin(np.radians(35))]], np.float32)
    lifted = (points + np.array((0, 0, 0.02))).astype(np.float32)
    dark = street.find_occluded(lifted, to_sun, np.full(len(points), 300.0, np.float32))
    bright = picture.rgb[rows, columns].mean(axis=1)
    assert 20 < dark.sum() < len(dark)
    assert np.median(bright[dark]) < 0.7 * np.median(bright[~dark])


def test_a_thin_pole_covers_pixels_by_its_width(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    """A lamp post a fraction of a pixel wide takes that fraction of the sky's light, wherever it falls on the grid."""
    camera, overcast = Camera(width=320, height=192, fov_deg=70), WEATHERS["overcast"]

    def light(lamps: np.ndarray) -> np.ndarray:
        scene = Scene(small_town(lamps=lamps), standing([]))
        picture = render_radiance(scene, AHEAD, camera, overcast, np.random.default_rng(0), hidden=None)
        return picture.radiance.reshape(192, 320, 3)[84:93].mean(axis=2)  # between its head and the horizon

    sky, taken = light(np.zeros((0, 3))), {}
    for distance in (45.0, 90.0):
        rows = [sky - light(np.array([[distance, aside, 7.0]])) for aside in np.linspace(0.0, 0.5, 9)]
        assert min(row.sum(axis=1).min() for row in rows) > 0.03 * sky.mean()  # nowhere broken
        taken[distance] = [row.sum(axis=1).mean() for row in rows]
        assert np.std(taken[distance]) < 0.25 * np.mean(taken[distance])
    assert np.mean(taken[45.0]) == pytest.approx(2 * np.mean(taken[90.0]), rel=0.25)


def test_fog_and_rain_take_contrast(street: Scene):
    def contrast(weather: Weather) -> float:
        return float(shot(street, weather).rgb[40:150].astype(float).std())

    grey = Weather(cloud_cover=0.95)
    fog = [contrast(grey.model_copy(update={"visibility_m": sight})) for sight in (5000.0, 500.0, 120.0, 40.0)]
    rain = [contrast(grey.model_copy(update={"rain_mm_h": rate})) for rate in (1.0, 20.0, 100.0)]
    assert fog == sorted(fog, reverse=True)
    assert rain == sorted(rain, reverse=True)


def test_night_is_darker_than_dusk_than_day(street: Scene):
    means = [shot(street, WEATHERS[name]).rgb.mean() for name in ("clear", "sunset", "night")]
    assert means == sorted(means, reverse=True)
    assert means[2] < 0.5 * means[0]


@pytest.mark.parametrize(("letter", "band", "row"), [("r", 0, 1), ("G", 1, -1), ("r", 0, 0.5), ("G", 1, -0.5)])
def test_signals_show_their_state(
    small_town: Callable[..., Town], standing: Callable[..., Trace], letter: str, band: int, row: float
):
    walkers = int(abs(row) < 1)  # a head of two lenses
    signals = Signals(np.array([[8.0, 0.0, 2.0]]), np.array([np.pi]), np.array([[8.0, -1.0]]), ("x:0",), walkers)
    trace = replace(standing([]), light=np.array(["x:0"]), light_state=np.array([[letter]]))
    camera = Camera(width=320, height=192, noise=0)
    scene = Scene(small_town(signals=signals), trace)
    picture = shot(scene, camera=camera)
    lens = transform_points(inverse(AHEAD), np.array([[7.89, 0.0, 2.0 + 0.32 * row]]))
    column, line = np.rint(project_optical(camera, lens)[0]).astype(int)
    colour = picture.rgb[line, column].astype(int)
    assert colour.argmax() == band
    assert colour[band] > 150
    assert picture.instance[line, column] == -1
    assert picture.semantic[line, column] == SEMANTICS["traffic_light"]


def test_signs_differ_and_face_their_reader(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    camera = Camera(width=320, height=192, noise=0)
    faces = []
    for kind in ("stop", "yield", "speed_30", "speed_60"):
        signs = Signs(np.array([[4.0, 0.0, 1.5]]), np.array([np.pi]), (kind,))
        picture = shot(Scene(small_town(signs=signs), standing([])), camera=camera)
        own = picture.instance == -1
        assert own.sum() > 200
        faces.append(picture.rgb[own].mean(axis=0))
    stop, give_way, thirty, _ = faces
    assert stop[0] > 1.8 * stop[1]  # mostly red
    assert thirty.min() > 1.5 * stop[1]
    assert give_way[0] > give_way[1]


def test_heat_shows_people_and_engines_by_night(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    actors = [("veh0", "car", 3, 12.0, -3.0, np.pi), ("parked0", "car", 3, 12.0, 0.0, np.pi)]
    actors.append(("ped0", "pedestrian", 0, 10.0, 3.0, np.pi))
    scene = Scene(small_town(), standing(actors))
    settings = Infrared(width=320, height=192)
    image = render_thermal(scene, AHEAD, settings, WEATHERS["night"], np.random.default_rng(0)) / 100.0
    instance = shot(scene, camera=Camera(width=320, height=192)).instance
    driving, parked, person, rest = (image[instance == number] for number in (1, 2, 3, 0))
    assert np.percentile(person, 90) > np.median(rest) + 8
    assert np.percentile(driving, 90) > np.percentile(parked, 90) + 3
    by_day = render_thermal(scene, AHEAD, settings, CLEAR, np.random.default_rng(0)) / 100.0
    assert np.median(by_day[120:]) > np.median(image[120:]) + 10  # the road in the sun
