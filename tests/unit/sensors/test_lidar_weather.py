"""Whole sweeps: weather, named beams, CARLA's returns, and spins that take time."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flcav.config import InputError, parse_config
from flcav.geometry import pose, transform_points
from flcav.sensors.lidar.beams import BEAMS
from flcav.sensors.lidar.lidar import CarlaReturns, Lidar, build_ray_pattern, point_times_s, scan
from flcav.sensors.lidar.rolling import Motion
from flcav.sensors.observe import observe
from flcav.sensors.rig import Rig
from flcav.world.map.town import Town
from flcav.world.materials import REFLECTIVITY, Material
from flcav.world.scene import Scene
from flcav.world.trace import Trace
from flcav.world.weather import WEATHERS, Weather

WALL = np.array([[30.0, 0.0, 0.0, 10.0, 200.0, 30.0]])  # a wall at x = 25
AT = pose(0.0, 0.0, 2.0)
PERFECT: dict[str, Any] = {"noise_m": 0.0, "dropout": 0.0, "sensitivity_m": 1e4}


@pytest.fixture(scope="module")
def walled(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    return Scene(small_town(buildings=WALL), standing([("veh0", "car", 3, 12.0, 3.0, 2.5)]))


def sweep(scene: Scene, weather: Weather | None = None, seed: int = 0, **settings: Any) -> np.ndarray:
    return scan(scene, AT, Lidar(**settings), np.random.default_rng(seed), weather=weather).points


def test_weather_that_is_no_matter_to_a_lidar_changes_no_byte(walled: Scene):
    clear = sweep(walled)
    for name in ("clear", "overcast", "sunset", "night"):
        np.testing.assert_array_equal(sweep(walled, WEATHERS[name]), clear)


def test_same_weather_and_stream_same_bytes(walled: Scene):
    for weather in (WEATHERS["heavy_rain"], Weather(visibility_m=40.0)):
        first = sweep(walled, weather)
        assert first.tobytes() == sweep(walled, weather).tobytes() != sweep(walled, weather, seed=1).tobytes()


def test_fog_takes_far_points_and_adds_near_ones(walled: Scene):
    def reach(visibility_m: float) -> np.ndarray:
        points = sweep(walled, Weather(visibility_m=visibility_m), up_deg=15.0)
        return np.linalg.norm(points[:, :3], axis=1)

    clear, misty, dense = reach(20_000.0), reach(150.0), reach(30.0)
    assert clear.max() > misty.max() > dense.max()
    assert dense.max() < 30
    sky = (dense > 4) & (dense < 9)
    assert sky.sum() > 1.5 * ((clear > 4) & (clear < 9)).sum()


def test_rain_points_belong_to_nobody(walled: Scene):
    lidar = Lidar(up_deg=40.0, down_deg=20.0)
    points, actor, *_ = scan(walled, AT, lidar, np.random.default_rng(0), weather=WEATHERS["heavy_rain"])
    near = np.linalg.norm(points[:, :3], axis=1) < 10
    assert near.sum() > 500
    assert (actor[near] == -1).all()


def test_rain_makes_ranges_worse(walled: Scene):
    dry, wet = (sweep(walled, weather, up_deg=-5.0, **PERFECT) for weather in (None, Weather(rain_mm_h=1.0)))
    assert len(dry) == len(wet)
    ratio = np.linalg.norm(wet[:, :3], axis=1) / np.linalg.norm(dry[:, :3], axis=1)
    same = np.abs(ratio - 1) < 0.1  # else it is a drop
    assert same.mean() > 0.95
    assert ratio[same].std() == pytest.approx(0.02 * (1 - np.exp(-1)) ** 2, rel=0.05)


def test_a_wet_road_is_darker_and_only_the_road(walled: Scene):
    dry, wet = (sweep(walled, weather, **PERFECT) for weather in (None, Weather(wetness=1.0)))
    assert len(dry) == len(wet)
    road = (np.abs(dry[:, 2] + 2) < 0.01) & (np.abs(dry[:, 1]) < 6.5) & (dry[:, 0] < 0)
    assert (wet[road, 3] < 0.7 * dry[road, 3]).all()
    np.testing.assert_array_equal(wet[dry[:, 2] > 0], dry[dry[:, 2] > 0])
    far, near = (np.abs(np.linalg.norm(dry[:, :3], axis=1) - r) < 1 for r in (20.0, 6.0))
    assert np.mean(wet[road & far, 3] / dry[road & far, 3]) < np.mean(wet[road & near, 3] / dry[road & near, 3])
    assert REFLECTIVITY[Material.ROAD] > dry[road, 3].max() > wet[road, 3].max()


@pytest.mark.parametrize(("name", "channels", "high", "low"), [
    ("vlp16", 16, 15.0, -15.0),
    ("hdl32e", 32, 10.67, -30.67),
    ("hdl64e", 64, 2.0, -24.33),
    ("os1_128", 128, 22.5, -22.5),
    ("vls128", 128, 15.0, -25.0),
    ("os0_32", 32, 45.0, -45.0),
    ("os2_64", 64, 11.25, -11.25),
    ("pandar40", 40, 15.0, -25.0),
    ("pandar64", 64, 15.0, -25.0),
    ("pandar128", 128, 15.0, -25.0),
    ("at128", 128, 12.9, -12.5),
    ("waymo64", 64, 2.4, -17.6),
])  # fmt: skip
def test_known_beams_by_name(name: str, channels: int, high: float, low: float):
    lidar = parse_config(Lidar, {"beams": name}, "rig.yaml")
    assert (lidar.channels, lidar.range_m) == (channels, BEAMS[name].range_m)
    elevation = np.degrees(np.arcsin(build_ray_pattern(lidar).reshape(channels, lidar.azimuth_steps, 3)[:, 0, 2]))
    assert (np.diff(elevation) < 0).all()
    assert (elevation[0], elevation[-1]) == (pytest.approx(high, abs=1e-3), pytest.approx(low, abs=1e-3))
    assert parse_config(Lidar, lidar.model_dump(mode="json"), "manifest") == lidar


def test_kittis_lidar_has_two_blocks():
    elevation = np.array(BEAMS["hdl64e"].elevations_deg)
    np.testing.assert_allclose(np.diff(elevation[:32]), -1 / 3, atol=1e-3)
    np.testing.assert_allclose(np.diff(elevation[32:]), -0.5, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "step", "high", "low"),
    [
        ("pandar40", 1 / 3, 2.0, -6.0),
        ("pandar64", 1 / 6, 2.0, -6.0),
        ("pandar128", 1 / 8, 2.0, -6.0),
        ("pandar128", 1 / 2, -6.0, -24.5),
        ("at128", 1 / 5, 12.9, -12.5),
    ],
)
def test_beams_are_closest_where_the_manual_says(name: str, step: float, high: float, low: float):
    elevation = np.array(BEAMS[name].elevations_deg)
    within = elevation[(elevation <= high + 1e-6) & (elevation >= low - 1e-6)]
    assert len(within) == round((high - low) / step) + 1
    np.testing.assert_allclose(np.diff(within), -step, atol=1.1e-3)


def test_waymo_s_beams_are_three_times_as_far_apart_at_the_bottom():
    apart = -np.diff(BEAMS["waymo64"].elevations_deg)
    assert (np.diff(apart) > -2e-3).all()
    assert apart[-1] / apart[0] == pytest.approx(3, rel=0.05)


def test_beams_leave_the_rest_to_the_user():
    lidar = Lidar(beams="hdl64e", azimuth_steps=512, range_m=60.0, noise_m=0.01)
    assert (lidar.azimuth_steps, lidar.range_m, lidar.noise_m) == (512, 60.0, 0.01)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"beams": "hdl65"}, "no beams 'hdl65'; known beams: vlp16"),
        ({"beams": "vlp16", "channels": 32}, "'vlp16' settle channels"),
        ({"beams": "vlp16", "elevations_deg": [1.0] * 16}, "'vlp16' settle elevations_deg"),
        ({"rolling": True, "rate_hz": 2.0}, r"rate_hz must be 5\.0 or more"),
        ({"carla": {"dropoff_general_rate": 2}}, r"carla\.dropoff_general_rate' = 2"),
    ],
)
def test_bad_settings_get_one_sentence(values: dict[str, Any], message: str):
    with pytest.raises(InputError, match=message):
        parse_config(Lidar, values, "rig.yaml")


def test_carlas_returns(walled: Scene):
    exact: dict[str, Any] = {"noise_m": 0.0, "glass_pass": 0.0, "azimuth_steps": 2000}
    settings = CarlaReturns(dropoff_general_rate=0.0, dropoff_zero_intensity=0.0)
    whole = sweep(walled, carla=settings, **exact)
    distance = np.linalg.norm(whole[:, :3], axis=1)
    np.testing.assert_allclose(whole[:, 3], np.exp(-0.004 * distance), rtol=1e-5)
    half = sweep(walled, carla=CarlaReturns(), **exact)
    assert len(half) / len(whole) == pytest.approx(0.55, abs=0.01)  # nothing here is dimmer than 0.8
    steep = CarlaReturns(dropoff_general_rate=0.0, atmosphere_attenuation_rate=0.1)
    kept = sweep(walled, carla=steep, **exact)
    lost = np.where(np.exp(-0.1 * distance) > 0.8, 0.0, 0.4 * (1 - np.exp(-0.1 * distance) / 0.8))
    assert len(kept) / len(whole) == pytest.approx(1 - lost.mean(), abs=0.01)
    np.testing.assert_array_equal(half, sweep(walled, WEATHERS["heavy_rain"], carla=CarlaReturns(), **exact))


def test_a_spin_over_a_world_that_stands_still_is_the_same(walled: Scene):
    still, rolling = sweep(walled), sweep(walled, rolling=True)
    np.testing.assert_allclose(rolling, still, atol=1e-5)
    lidar = Lidar(rolling=True)
    times = point_times_s(lidar, rolling)
    assert times.min() == pytest.approx(-0.05, abs=1e-3)
    assert times.max() == pytest.approx(0.05, abs=1e-3)
    assert np.abs(times[(rolling[:, 0] > 0) & (np.abs(rolling[:, 1]) < 0.1)]).max() < 0.005
    assert (point_times_s(Lidar(), still) == 0).all()


@pytest.fixture
def driving(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    """cav0 drives at 15 m/s towards a wall, while a truck beside it drives twice as fast."""
    trace = standing([("cav0", "car", 3, 0.0, 0.0, 0.0), ("veh1", "truck", 0, 10.0, 4.0, 0.0)])
    trace.velocity[0, :, 0] = (15.0, 30.0)
    return Scene(small_town(buildings=WALL), trace)


def test_a_moving_sensor_bends_walls(driving: Scene):
    lidar = Lidar(**PERFECT, rolling=True, azimuth_steps=1800)
    points, actor, *_ = scan(driving, AT, lidar, np.random.default_rng(0), hidden=0)
    assert (driving.index, driving.offset_s) == (0, 0.0)
    times = point_times_s(lidar, points)
    on_wall = (actor == -1) & (points[:, 2] > 0.0) & (np.abs(points[:, 0] + 15.0 * times - 25.0) < 0.03)
    assert np.count_nonzero(on_wall) > 1500  # the rest is ledges and what stands in front
    slope, middle = np.polyfit(times[on_wall], points[on_wall, 0], 1)
    assert (slope, middle) == (pytest.approx(-15.0, abs=0.3), pytest.approx(25.0, abs=0.01))
    assert np.ptp(points[on_wall, 0]) > 0.4


def test_a_moving_actor_is_where_it_is_when_the_beams_pass(driving: Scene):
    """Seen from a standing sensor, the truck's tail lies at its place at the time of each point."""
    lidar = Lidar(**PERFECT, rolling=True, azimuth_steps=1800, channels=64)
    for facing in (0.0, np.pi):  # ahead: mid spin; behind: at the beginning or the end of it
        at = pose(0.0, 4.0, 2.0, yaw=facing)
        points, actor, *_ = scan(driving, at, lidar, np.random.default_rng(0))
        truck = points[actor == 1]
        back = truck[:, 0] * np.cos(facing) - 30.0 * point_times_s(lidar, truck)
        assert back.min() == pytest.approx(10 - 3.9, abs=0.25)


def test_points_find_back_to_their_body(driving: Scene):
    """Poses of the scene at other times are the oracle."""
    driving.trace.acceleration[0, 1] = (-4.0, 1.0, 0.0)
    driving.trace.yaw_rate[0, 1] = 0.7
    at_spin, motion = driving.world_from_actor(1), Motion.of(driving.trace, 0, 1)
    body = np.array([[3.9, 1.2, 0.5], [-3.9, -1.2, 3.0], [0.0, 0.0, 0.0]])
    here = transform_points(at_spin, body)
    for time_s in (-0.05, 0.0, 0.08):
        driving.move_to(0, time_s)
        there = transform_points(driving.world_from_actor(1), body)
        times = np.full(len(body), time_s, np.float32)
        np.testing.assert_allclose(motion.carry(here, times), there, atol=1e-6)
        np.testing.assert_allclose(motion.bring_back(there, times), here, atol=1e-6)


def test_what_comes_towards_a_rolling_lidar_does_not_hide_itself(driving: Scene):
    driving.trace.velocity[0] = [(0.0, 0.0, 0.0), (-30.0, 0.0, 0.0)]
    driving.trace.position[0, 1] = (
        -20.0,
        0.0,
        0.0,
    )  # seen at both ends of the spin, 1.5 m from its place in the middle
    rig = {"lidars": {"lidar": {"mount": {"z": 1.8}, "settings": {"rolling": True, "channels": 64}}}}
    frame = observe(driving, Rig.model_validate(rig), "cav0", 0, scene_name="s", seed=0)
    assert frame.annotations.track.tolist() == ["veh1"]
    assert frame.annotations.returns[0] > 100
    assert frame.annotations.occlusion[0] < 0.1


def test_a_spin_of_few_columns_has_fewer_sectors(walled: Scene):
    coarse: dict[str, Any] = {"azimuth_steps": 7, "channels": 16}
    np.testing.assert_allclose(sweep(walled, rolling=True, **coarse), sweep(walled, **coarse), atol=1e-5)


def test_a_spin_may_begin_between_instants(driving: Scene):
    lidar = Lidar(**PERFECT, rolling=True)
    driving.move_to(0, 0.04)
    scan(driving, AT, lidar, np.random.default_rng(0), hidden=0)
    assert driving.offset_s == 0.04
    driving.move_to(0, 0.08)
    with pytest.raises(ValueError, match="must lie within"):
        scan(driving, AT, lidar, np.random.default_rng(0), hidden=0)
