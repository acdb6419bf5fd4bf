from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flcav.config import InputError, parse_config
from flcav.geometry import pose
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern, cast, draw_passes, scan
from flcav.sensors.rig import RIGS, Rig
from flcav.world.map.town import Town
from flcav.world.materials import REFLECTIVITY, Material
from flcav.world.scene import Scene
from flcav.world.shapes import SHAPES
from flcav.world.trace import Trace

PERFECT: dict[str, Any] = {"noise_m": 0.0, "dropout": 0.0, "sensitivity_m": 1e4}
AT = pose(0.0, 0.0, 2.0)
WALL = np.array([[30.0, 0.0, 0.0, 10.0, 200.0, 30.0]])  # a wall at x = 25


@pytest.fixture(scope="module")
def walled(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    return Scene(small_town(buildings=WALL), standing([]))


def sweep(scene: Scene, at: np.ndarray = AT, seed: int = 0, **settings: Any) -> np.ndarray:
    return scan(scene, at, Lidar(**{**PERFECT, **settings}), np.random.default_rng(seed)).points


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"range_m": -5}, "field 'range_m' = -5"),
        ({"channels": 0}, "field 'channels' = 0"),
        ({"dropout": 1.0}, "field 'dropout'"),
        ({"noise_m": -0.1}, "field 'noise_m'"),
        ({"up_deg": -30.0}, "down_deg -25.0 must be below up_deg -30.0"),
        ({"channels": 3, "elevations_deg": [1.0, 2.0]}, "3 channels need as many elevations_deg, not 2"),
        ({"channels": 2, "elevations_deg": [1.0, 95.0]}, "between|within -90 and 90"),
        ({"rnage_m": 5}, "unknown field 'rnage_m'"),
    ],
)
def test_bad_settings_get_one_sentence(values: dict[str, Any], message: str):
    with pytest.raises(InputError, match=message) as caught:
        parse_config(Lidar, values, "recipe.yaml")
    assert "\n" not in str(caught.value)


def test_pattern_has_the_channels_and_steps_asked_for():
    lidar = Lidar(channels=5, azimuth_steps=12, up_deg=10.0, down_deg=-30.0)
    rays = build_ray_pattern(lidar).reshape(5, 12, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1, atol=1e-6)
    elevation = np.degrees(np.arcsin(rays[..., 2]))
    np.testing.assert_allclose(elevation, np.repeat([[10.0], [0], [-10], [-20], [-30]], 12, axis=1), atol=1e-4)
    azimuth = np.degrees(np.arctan2(rays[2, :, 1], rays[2, :, 0])) % 360
    np.testing.assert_allclose(azimuth, np.arange(12) * 30, atol=1e-4)
    uneven = build_ray_pattern(Lidar(channels=2, azimuth_steps=4, elevations_deg=(-8.0, 1.0)))
    assert np.degrees(np.arcsin(uneven[[0, -1], 2])) == pytest.approx([1.0, -8.0], abs=1e-4)


def test_ranges_are_those_of_the_planes(walled: Scene):
    points = sweep(walled, range_m=60.0)[:, :3].astype(float)
    ahead = points[(points[:, 0] > 5) & (points[:, 1] > -8) & (points[:, 1] < 30)]  # clear of the pole
    on_wall, on_ground = np.abs(ahead[:, 0] - 25.0) < 0.15, np.abs(ahead[:, 2] + 2.0) < 0.15
    walks = (ahead[:, 2] > -1.95) & (ahead[:, 2] < -1.85)
    ledges = (ahead[:, 0] > 23.4) & (ahead[:, 0] < 25.2)
    assert (on_wall | on_ground | walks | ledges).all()
    assert on_wall.sum() > 300 < on_ground.sum()
    assert np.linalg.norm(points, axis=1).max() <= 60.0


def test_a_tilted_sensor_measures_the_same_world(walled: Scene):
    level = sweep(walled, channels=64, azimuth_steps=1024)
    tilted = pose(0.0, 0.0, 2.0, yaw=1.0, pitch=0.1, roll=-0.05)
    points = sweep(walled, tilted, channels=64, azimuth_steps=1024)[:, :3].astype(float)
    world = points @ tilted[:3, :3].T + tilted[:3, 3]
    near = np.hypot(world[:, 0], world[:, 1]) < 6
    assert near.sum() > 1000
    assert np.abs(world[near, 2]).max() < 0.01  # the road
    assert np.abs(level[np.hypot(level[:, 0], level[:, 1]) < 6, 2] + 2).max() < 0.01


def test_noise_and_dropout_are_as_wide_as_asked(walled: Scene):
    clean = sweep(walled, range_m=20.0)
    noisy = sweep(walled, range_m=20.0, noise_m=0.05)
    assert len(clean) == len(noisy)
    error = np.linalg.norm(noisy[:, :3], axis=1) - np.linalg.norm(clean[:, :3], axis=1)
    assert error.std() == pytest.approx(0.05, rel=0.05)
    assert error.mean() == pytest.approx(0.0, abs=0.002)
    thinned = sweep(walled, range_m=20.0, dropout=0.3)
    assert len(thinned) / len(clean) == pytest.approx(0.7, abs=0.02)


def test_power_equation_decides_what_is_detected(walled: Scene):
    """On flat road P = rho h / R^3, so that it fades out where R^3 = rho h / P_min."""
    height, sensitivity = 2.0, 200.0
    points = sweep(walled, channels=128, up_deg=-2.0, down_deg=-20.0, sensitivity_m=sensitivity, range_m=100.0)
    road = points[(np.abs(points[:, 1]) < 2) & (points[:, 0] < 0)]
    reach = np.linalg.norm(road[:, :3], axis=1).max()
    expected = (REFLECTIVITY[Material.ROAD] * height * sensitivity**2 / 0.9) ** (1 / 3)
    assert expected * 0.95 <= reach <= expected * (1 / 0.7) ** (1 / 3) * 1.01
    near = road[np.linalg.norm(road[:, :3], axis=1) < 8]
    cosine = height / np.linalg.norm(near[:, :3], axis=1)
    np.testing.assert_allclose(near[:, 3], REFLECTIVITY[Material.ROAD] * cosine, rtol=1e-3)


@pytest.fixture(scope="module")
def facing_car(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    return Scene(small_town(), standing([("veh0", "car", 3, 12.0, 3.0, 2.5)]))


def car_points(scene: Scene, **settings: Any) -> np.ndarray:
    lidar = Lidar(**{**PERFECT, "channels": 64, "azimuth_steps": 2048, **settings})
    points, actor, *_ = scan(scene, AT, lidar, np.random.default_rng(0))
    return points[actor == 0]


def test_glass_lets_as_many_rays_pass_as_asked(facing_car: Scene):
    lidar = Lidar(**PERFECT, channels=64, azimuth_steps=2048)
    surfaces = facing_car.surfaces
    on_glass = {}
    for share in (0.0, 0.9, 1.0):
        settings = lidar.model_copy(update={"glass_pass": share})
        echoes = cast(facing_car, AT, settings, draw_passes(settings, np.random.default_rng(1)))
        on_car = echoes.instance == 1
        on_glass[share] = np.count_nonzero(on_car & (echoes.material == Material.GLASS))
        rows = surfaces.first[echoes.instance[on_car]] + echoes.face[on_car]
        np.testing.assert_array_equal(surfaces.material[rows], echoes.material[on_car])
        assert (echoes.panes[~on_car & (echoes.instance >= 0)] != 1).all()  # out again through a second pane
    assert on_glass[0.0] > 100
    assert on_glass[1.0] == 0
    assert on_glass[0.9] / on_glass[0.0] == pytest.approx(0.1, abs=0.08)


def test_returns_of_a_car_fall_with_distance_as_on_real_sensors(
    small_town: Callable[..., Town], standing: Callable[..., Trace]
):
    """64 x 2048 rays over 26.8 degrees: thousands at 8 m, about a hundred at 40 m."""
    counts = []
    for distance in (8.0, 15.0, 25.0, 40.0):
        scene = Scene(small_town(), standing([("veh0", "car", 3, distance, 0.0, np.pi / 4)]))
        lidar = Lidar(channels=64, azimuth_steps=2048, up_deg=2.0, down_deg=-24.8, range_m=120.0)
        _, actor, *_ = scan(scene, pose(0.0, 0.0, 1.8), lidar, np.random.default_rng(0))
        counts.append(np.count_nonzero(actor == 0))
    lowest, highest = (2000, 550, 180, 60), (5500, 1500, 550, 240)
    assert all(low < count < high for low, count, high in zip(lowest, counts, highest)), counts


def test_a_car_is_a_shell_with_something_inside(facing_car: Scene):
    sedan = SHAPES["car"][3]
    points = car_points(facing_car)
    body = (points[:, :3].astype(float) + AT[:3, 3] - (12.0, 3.0, 0.0)) @ pose(0, 0, 0, 2.5)[:3, :3]
    inside = (np.abs(body[:, 0]) < 0.35 * sedan.length) & (np.abs(body[:, 1]) < 0.36 * sedan.width)
    inside &= body[:, 2] < 0.85 * sedan.height
    assert 0.02 < inside.mean() < 0.25
    seen_side = np.sign((-AT[:3, 3] + (12.0, 3.0, 0.0)) @ pose(0, 0, 0, 2.5)[:3, :3])[1]
    far_side = (body[:, 1] * seen_side > 0.45 * sedan.width) & (body[:, 2] < 0.5 * sedan.height)
    assert far_side.mean() < 0.05


def test_the_hidden_carrier_returns_nothing(facing_car: Scene):
    lidar = Lidar(**PERFECT)
    _, actor, *_ = scan(facing_car, AT, lidar, np.random.default_rng(0), hidden=0)
    assert len(actor) > 10_000
    assert (actor == -1).all()
    _, actor, *_ = scan(facing_car, AT, lidar, np.random.default_rng(0))
    assert (actor == 0).any()


def test_same_stream_same_bytes(facing_car: Scene):
    first, second, other = (sweep(facing_car, seed=seed, noise_m=0.02, dropout=0.01).tobytes() for seed in (3, 3, 4))
    assert first == second != other


def test_rigs_fit_what_carries_them():
    car, roadside = RIGS["car"].lidars["lidar"], RIGS["roadside"].lidars["lidar"]
    assert car.mount.z > SHAPES["car"][3].height + 0.2
    assert car.settings.channels == 32
    assert (roadside.mount.x, roadside.mount.y, roadside.mount.z) == (0.0, 0.0, 0.0)
    assert roadside.settings.channels == 64
    with pytest.raises(InputError, match=r"lidars\.roof\.settings\.range_m"):
        parse_config(Rig, {"lidars": {"roof": {"settings": {"range_m": -1}}}}, "recipe.yaml")
    with pytest.raises(InputError, match="at least one LiDAR"):
        parse_config(Rig, {"lidars": {}}, "recipe.yaml")
