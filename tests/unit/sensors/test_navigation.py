"""GNSS and IMU: geodesy against PROJ, errors with the statistics asked for, in any order."""

from collections.abc import Callable

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.geometry import pose
from flcav.sensors.navigation import (
    STEP_S,
    Gnss,
    Imu,
    draw_gauss_markov,
    draw_random_walk,
    measure_inertia,
    measure_position,
)
from flcav.world.geodesy import convert_to_geodetic, convert_to_map
from flcav.world.map.parameters import GeoReference
from flcav.world.map.town import Town
from flcav.world.scene import Scene
from flcav.world.trace import Trace

G = 9.80665
EXACT_GNSS = Gnss(noise_m=0, noise_up_m=0, bias_m=0, bias_up_m=0)
EXACT_IMU = Imu(force_noise=0, rate_noise=0, force_bias=0, rate_bias=0, force_walk=0, rate_walk=0)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@given(
    latitude=st.floats(-89.0, 89.0),
    longitude=st.floats(-180.0, 180.0),
    altitude=st.floats(-100.0, 5000.0),
    east=st.floats(-20_000.0, 20_000.0),
    north=st.floats(-20_000.0, 20_000.0),
    up=st.floats(-50.0, 500.0),
)
@settings(max_examples=100, deadline=None)
def test_places_on_earth_agree_with_proj(
    latitude: float, longitude: float, altitude: float, east: float, north: float, up: float
):
    origin = GeoReference(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    ours = convert_to_geodetic(origin, np.array((east, north, up)))
    back = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lat_0={latitude!r} +lon_0={longitude!r} +h_0={altitude!r} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    lon, lat, height = back.transform(east, north, up)
    assert ours[0] == pytest.approx(lat, abs=1e-11)
    assert (ours[1] - lon + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)
    assert ours[2] == pytest.approx(height, abs=1e-6)


def test_many_points_at_once():
    enu = np.random.default_rng(0).uniform(-500, 500, (4, 5, 3))
    many = convert_to_geodetic(GeoReference(), enu)
    np.testing.assert_allclose(many[2, 3], convert_to_geodetic(GeoReference(), enu[2, 3]))
    turned = GeoReference(
        latitude_deg=-33.0, longitude_deg=151.0, altitude_m=40.0, x_axis=(0.6, 0.8), y_axis=(-0.9, 0.5)
    )
    np.testing.assert_allclose(convert_to_map(turned, convert_to_geodetic(turned, enu)), enu, atol=1e-6)
    np.testing.assert_allclose(convert_to_geodetic(GeoReference(), np.zeros(3)), (49.0, 8.4, 0.0), atol=1e-8)


def test_errors_are_the_same_in_whatever_order_times_are_asked():
    times = np.arange(0.0, 12.0, 0.35)
    for error in (
        lambda t: draw_gauss_markov(rng(3), t, np.ones(2), 5.0),
        lambda t: draw_random_walk(rng(3), t, np.ones(2), np.ones(2)),
    ):
        forwards = [error(t) for t in times]
        backwards = [error(t) for t in times[::-1]][::-1]
        np.testing.assert_array_equal(forwards, backwards)
        np.testing.assert_array_equal(forwards, error(times))
        assert np.ptp(forwards) > 0.1


def test_what_wanders_has_its_spread_and_its_memory():
    at = np.array(
        [
            [draw_gauss_markov(rng(seed), t, np.array((2.0,)), 10.0)[0] for t in (0.0, 60.0, 70.0)]
            for seed in range(3000)
        ]
    )
    np.testing.assert_allclose(at.std(axis=0), 2.0, rtol=0.05)
    assert np.corrcoef(at[:, 1], at[:, 2])[0, 1] == pytest.approx(np.exp(-1), abs=0.05)
    assert np.corrcoef(at[:, 0], at[:, 1])[0, 1] == pytest.approx(0.0, abs=0.06)


def test_a_walk_grows_with_the_root_of_time():
    at = np.array(
        [
            [draw_random_walk(rng(seed), t, np.array((0.5,)), np.array((0.3,)))[0] for t in (0.0, 25.0)]
            for seed in range(3000)
        ]
    )
    assert at[:, 0].std() == pytest.approx(0.5, rel=0.05)
    assert (at[:, 1] - at[:, 0]).std() == pytest.approx(0.3 * 5, rel=0.05)
    between = [
        draw_random_walk(rng(1), t, np.array((0.5,)), np.array((0.3,)))[0]
        for t in (1.0, 1.0 + STEP_S / 2, 1.0 + STEP_S)
    ]
    assert between[1] == pytest.approx((between[0] + between[2]) / 2)


@pytest.fixture
def scene(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    trace = standing([("cav0", "car", 3, 10.0, 20.0, 0.4)], instants=3)
    return Scene(small_town(), trace)


def test_a_fix_is_where_the_antenna_is(scene: Scene):
    at = scene.world_from_actor(0) @ pose(1.0, 0.0, 1.5)
    found = measure_position(scene, at, EXACT_GNSS, rng(), rng())
    np.testing.assert_allclose(found, convert_to_geodetic(scene.town.geo, at[:3, 3]))
    metres = (found - (49.0, 8.4, 0.0)) * (111_214.0, 73_174.0, 1.0)
    np.testing.assert_allclose(metres[[1, 0, 2]], at[:3, 3], atol=0.03)


def test_fixes_scatter_as_asked_and_share_a_bias(scene: Scene):
    at = scene.world_from_actor(0)
    gnss = Gnss(noise_m=0.5, noise_up_m=1.0, bias_m=3.0, bias_up_m=6.0)
    fixes = np.array([measure_position(scene, at, gnss, rng(seed), rng(99)) for seed in range(2000)])
    metres = fixes * (111_214.0, 73_174.0, 1.0)
    np.testing.assert_allclose(metres.std(axis=0), (0.5, 0.5, 1.0), rtol=0.06)
    bias = metres.mean(axis=0) - convert_to_geodetic(scene.town.geo, at[:3, 3]) * (111_214.0, 73_174.0, 1.0)
    assert np.abs(bias).max() > 1.0
    later = measure_position(scene, at, gnss, rng(0), rng(99))
    scene.move_to(2)
    assert not np.array_equal(measure_position(scene, at, gnss, rng(0), rng(99)), later)
    scene.move_to(0)
    np.testing.assert_array_equal(measure_position(scene, at, gnss, rng(0), rng(99)), later)


def test_at_rest_gravity_is_felt_upwards_in_the_units_own_axes(scene: Scene):
    for carrier in (None, 0):
        level = measure_inertia(scene, pose(0, 0, 1, 0.7), carrier, EXACT_IMU, rng(), rng())
        np.testing.assert_allclose(level, (0, 0, G, 0, 0, 0), atol=1e-12)
    nose_down = measure_inertia(scene, pose(0, 0, 1, 0.7, pitch=0.3), None, EXACT_IMU, rng(), rng())
    np.testing.assert_allclose(nose_down[:3], (-G * np.sin(0.3), 0, G * np.cos(0.3)), atol=1e-12)


def test_a_turn_is_felt_to_the_inside_and_more_away_from_the_centre(scene: Scene):
    speed, rate = 8.0, 0.5
    forward, left = np.array((np.cos(0.4), np.sin(0.4), 0)), np.array((-np.sin(0.4), np.cos(0.4), 0))
    scene.trace.acceleration[0, 0], scene.trace.yaw_rate[0, 0] = 1.5 * forward + speed * rate * left, rate
    at = scene.world_from_actor(0)
    felt = measure_inertia(scene, at, 0, EXACT_IMU, rng(), rng())
    np.testing.assert_allclose(felt, (1.5, speed * rate, G, 0, 0, rate), atol=1e-12)
    ahead = measure_inertia(scene, at @ pose(2.0, 0.0, 0.5), 0, EXACT_IMU, rng(), rng())
    np.testing.assert_allclose(ahead, (1.5 - rate**2 * 2.0, speed * rate, G, 0, 0, rate), atol=1e-12)
    tilted = measure_inertia(scene, at @ pose(0, 0, 0, roll=np.pi / 2), 0, EXACT_IMU, rng(), rng())
    np.testing.assert_allclose(tilted, (1.5, G, -speed * rate, 0, rate, 0), atol=1e-12)


def test_an_imus_noise_is_that_of_its_data_sheet(scene: Scene):
    imu = Imu(rate_hz=200.0, force_noise=0.01, rate_noise=0.002)
    readings = np.array([measure_inertia(scene, pose(0, 0, 1), None, imu, rng(seed), rng(5)) for seed in range(2000)])
    np.testing.assert_allclose(readings.std(axis=0), np.repeat((0.1, 0.02), 3), rtol=0.06)
    bias = readings.mean(axis=0) - (0, 0, G, 0, 0, 0)
    assert np.abs(bias[:3]).max() > 0.01
