"""Rain and fog on the LiDAR, against the papers' equations evaluated another way."""

import numpy as np
import pytest
from scipy.constants import speed_of_light
from scipy.integrate import quad
from scipy.special import beta

from flcav.sensors.lidar.air import (
    DROP_REFLECTANCE,
    N0,
    NEAREST_M,
    PULSE_S,
    QUANTILES,
    SPREAD_M,
    STEP_M,
    SURFACE_PER_SR,
    Air,
    add_air_returns,
    compute_air,
    compute_drops,
    compute_fog_returns,
    rain_extinction,
    rain_range_noise,
)
from flcav.sensors.lidar.returns import compute_wet_brightness
from flcav.world.weather import Weather

LEAST = 0.7 * 0.9 / 300.0**2


def air_of(**weather: float) -> Air:
    air = compute_air(Weather(**weather), 0.003, LEAST)
    assert air is not None
    return air


def received(fog_per_m: float, at_m: float, surface_m: float) -> float:
    """Return equation 10 of the paper, integrated by adaptive quadrature."""

    def scattered(t: float) -> float:
        r = at_m - speed_of_light * t / 2
        if r <= 0.9 or r > surface_m:
            return 0.0
        return np.sin(np.pi * t / (2 * PULSE_S)) ** 2 * min((r - 0.9) / 0.1, 1.0) * np.exp(-2 * fog_per_m * r) / r**2

    seen_since = [2 * (at_m - r) / speed_of_light for r in (1.0, 0.9, surface_m)]
    kinks = sorted(t for t in seen_since if 0 < t < 2 * PULSE_S)
    total, _ = quad(scattered, 0.0, 2 * PULSE_S, points=kinks or None, limit=200)
    return 0.046 * fog_per_m / np.log(20) / SURFACE_PER_SR * total


@pytest.mark.parametrize("visibility_m", [25.0, 60.0, 300.0])
@pytest.mark.parametrize("surface_m", [2.0, 4.0, 9.0, 100.0])
def test_fog_answers_as_the_integral_says(visibility_m: float, surface_m: float):
    fog = np.log(20) / visibility_m
    power, range_m = compute_fog_returns(fog, fog)
    entry = min(round(surface_m / STEP_M), len(power) - 1)
    candidates = np.arange(1.0, min(surface_m, 16.0) + 0.01, STEP_M)
    expected = [received(fog, at, surface_m) for at in candidates]
    assert power[entry] == pytest.approx(max(expected), rel=0.04)
    assert range_m[entry] == pytest.approx(candidates[int(np.argmax(expected))], abs=0.31)


def test_soft_returns_spread_as_beta_says():
    assert SPREAD_M.mean() == pytest.approx(10 * 2 / 22, rel=0.01)
    density = lambda x: x * (1 - x) ** 19 / beta(2, 20)  # noqa: E731
    assert quad(density, 0, SPREAD_M[QUANTILES // 4] / 10)[0] == pytest.approx(0.252, abs=0.01)


@pytest.mark.parametrize("rain_mm_h", [5.0, 40.0])
def test_brightest_drops_are_those_of_beams_drawn_drop_by_drop(rain_mm_h: float):
    """LISA itself: every drop of a beam from 0 to 12 m with its place and size; the brightest one counts."""
    rng, beams, reach, divergence = np.random.default_rng(0), 30_000, 12.0, 0.003
    extinction, slope = rain_extinction(rain_mm_h), 4.1 * rain_mm_h**-0.21
    volume = np.pi / 3 * reach * (np.tan(divergence) * reach / 2) ** 2
    number = rng.poisson(N0 / slope * volume, beams)
    beam = np.repeat(np.arange(beams), number)
    r = reach * rng.random(len(beam)) ** (1 / 3)
    size_mm = rng.exponential(1 / slope, len(beam))
    share = np.minimum((size_mm / (1e3 * np.tan(divergence) * r)) ** 2, 1)
    power = np.where(r > NEAREST_M, DROP_REFLECTANCE * share * np.exp(-2 * extinction * r) / r**2, 0)
    best = np.zeros(beams)
    np.maximum.at(best, beam, power)

    table = compute_drops(rain_mm_h, extinction, divergence, LEAST)
    for level in (LEAST, 3 * LEAST, 20 * LEAST):
        expected = 1 - np.exp(-np.interp(-level, -table.power, table.number))
        assert np.mean(best > level) == pytest.approx(expected, abs=0.006)
    near = np.abs(power / LEAST - 1.5) < 0.15
    expected = np.median(table.range_m[np.argmin(np.abs(table.power - 1.5 * LEAST))])
    assert np.median(r[near]) == pytest.approx(expected, rel=0.03)


def test_surfaces_get_dimmer_by_the_two_way_extinction():
    air = air_of(rain_mm_h=10.0, visibility_m=2000.0)
    distance = np.array([2.0, 10.0, 40.0], np.float32)
    extinction = 0.01 * 10**0.6 + np.log(20) / 2000
    _, bright, aerial = add_air_returns(distance, np.full(3, 0.5, np.float32), air, np.random.default_rng(1))
    assert not aerial.any()
    np.testing.assert_allclose(bright, 0.5 * np.exp(-2 * extinction * distance), rtol=1e-5)


def test_dense_fog_hides_what_is_far_and_answers_nearby():
    air = air_of(visibility_m=30.0)
    distance = np.repeat(np.array([3.0, 60.0, np.inf], np.float32), 1000)
    bright = np.repeat(np.array([0.3, 0.3, 0.0], np.float32), 1000)
    seen, power, aerial = (
        values.reshape(3, 1000) for values in add_air_returns(distance, bright, air, np.random.default_rng(0))
    )
    assert aerial.mean(axis=1).tolist() == [0.0, 1.0, 1.0]
    assert (seen[0] == 3).all()
    assert 4 < seen[1:].min() < seen[1:].max() < 12
    assert (power[1:] > 0).all()


def test_the_air_answers_no_farther_than_the_surface_is():
    rng = np.random.default_rng(3)
    distance = rng.uniform(1.0, 30.0, 20_000).astype(np.float32)
    for air in (air_of(visibility_m=20.0), air_of(rain_mm_h=50.0)):
        seen, _, aerial = add_air_returns(distance, np.full(20_000, 1e-4, np.float32), air, rng)
        assert (seen <= distance).all()
        assert aerial.any()
        assert (seen[~aerial] == distance[~aerial]).all()


def test_clear_air_is_no_air_at_all():
    assert compute_air(Weather(cloud_cover=1.0, sun_elevation_deg=-30.0, wetness=1.0), 0.003, LEAST) is None
    assert rain_range_noise(20.0) == pytest.approx(0.02)
    assert rain_range_noise(0.5) == pytest.approx(0.02 * 0.3935**2, rel=1e-3)


def test_water_darkens_more_the_flatter_one_looks():
    cosine = np.cos(np.radians([0.0, 30, 60, 75, 85, 89]))
    wet = [compute_wet_brightness(float(c), 0.17) for c in cosine]
    assert wet[0] == pytest.approx((1 - 0.02006) ** 2 / 1.33**2 / (1 - 0.472 * 0.17), rel=1e-3)
    assert (np.diff(wet) < 0).all()
    assert wet[-1] < 0.02
