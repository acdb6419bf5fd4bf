"""TR 37.885's large-scale propagation against the clause's numbers, worked out by hand and by quadrature."""

import math

import numpy as np
import pytest
from scipy import integrate, stats

from flcav.network.radio import budget
from flcav.network.radio.budget import PathState

# Table 6.2.1-1 in linear units: loss = C * d^n * f^m, with C, n, m worked out from the decibels of the table.
CLAUSE = {
    ("urban", PathState.LOS): (10**3.877, 1.67, 1.82),
    ("urban", PathState.NLOSV): (10**3.877, 1.67, 1.82),
    ("urban", PathState.NLOS): (10**3.685, 3.0, 1.89),
    ("highway", PathState.LOS): (10**3.24, 2.0, 2.0),
    ("highway", PathState.NLOSV): (10**3.24, 2.0, 2.0),
}


@pytest.mark.parametrize(("environment", "state"), CLAUSE)
def test_path_loss_is_that_of_the_table(environment, state):
    constant, distance_power, frequency_power = CLAUSE[environment, state]
    distance = np.array([3.0, 20.0, 150.0, 900.0])
    for frequency in (5.9, 6.0, 28.0):
        linear = constant * distance**distance_power * frequency**frequency_power
        found = budget.path_loss_db(distance, state, frequency, environment)
        np.testing.assert_allclose(10 ** (found / 10), linear, rtol=1e-9)


def test_path_loss_by_hand():
    """At 100 m and 6 GHz: lg 100 = 2, lg 6 = 0.778151."""
    states = [PathState.LOS, PathState.NLOSV, PathState.NLOS]
    assert budget.path_loss_db(100, states, 6.0) == pytest.approx([86.33235, 86.33235, 111.55706], abs=1e-5)
    assert budget.path_loss_db(100, PathState.LOS, 6.0, "highway") == pytest.approx(87.96303, abs=1e-5)


def test_a_highway_is_free_space_within_a_twentieth_of_a_decibel():
    wavelength = 299_792_458 / 5.9e9
    free_db = 20 * math.log10(4 * math.pi * 200 / wavelength)
    assert budget.path_loss_db(200, PathState.LOS, 5.9, "highway") == pytest.approx(free_db, abs=0.05)


def test_links_below_three_metres_lose_what_they_lose_at_three():
    assert (
        budget.path_loss_db([0.0, 1.0], PathState.NLOS, 5.9).tolist()
        == [float(budget.path_loss_db(3.0, PathState.NLOS, 5.9))] * 2
    )
    assert (budget.blockage_moments_db(0.0, 1.5, 1.6, 3.0)[0]) == 9


def test_a_highway_has_no_state_behind_buildings():
    with pytest.raises(ValueError, match="the highway environment has no state NLOS"):
        budget.path_loss_db([10.0, 20.0], [PathState.LOS, PathState.NLOS], 5.9, "highway")


def test_shadowing_by_state():
    states = [PathState.LOS, PathState.NLOSV, PathState.NLOS]
    assert budget.shadowing_sigma_db(states).tolist() == [3, 3, 4]
    assert budget.correlation_distance_m(states).tolist() == [10, 13, 13]
    assert budget.shadowing_sigma_db(states[:2], "highway").tolist() == [3, 3]
    assert budget.correlation_distance_m(states[:2], "highway").tolist() == [25, 25]


@pytest.mark.parametrize(
    ("lower", "higher", "blocker", "mean", "sigma"),
    [
        (1.7, 5.0, 1.6, 0.0, 0.0),  # case 1
        (1.6, 5.0, 1.6, 5.0, 4.0),  # not above, only level: case 3
        (1.6, 5.0, 3.0, 5.0, 4.0),  # case 3
        (1.6, 3.0, 3.0, 5.0, 4.0),  # not below, only level: case 3
        (1.6, 1.6, 3.0, 9.0, 4.5),  # case 2
    ],
)
def test_blockage_by_case(lower, higher, blocker, mean, sigma):
    found = budget.blockage_moments_db([100.0, 541.0, 1000.0], lower, higher, blocker)
    far = 45 - 41 if mean else 0  # 15 lg 1000 - 41; 15 lg 541 - 41 = -0.0022
    np.testing.assert_allclose(found[0], [mean, mean, mean + far], atol=1e-9)
    assert found[1].tolist() == [sigma] * 3


@pytest.mark.parametrize(("heights", "mean", "sigma"), [((1.6, 1.6, 3.0), 9.0, 4.5), ((1.6, 5.0, 3.0), 5.0, 4.0)])
def test_blockage_is_normal_in_decibels_and_never_a_gain(heights, mean, sigma):
    draws = np.random.default_rng(1).standard_normal(400_000)
    losses = budget.blockage_db(100.0, heights[0], heights[1], heights[2], draws)
    wanted, _ = integrate.quad(lambda x: x * stats.norm.pdf(x, mean, sigma), 0, mean + 12 * sigma)
    assert losses.min() == 0
    assert losses.mean() == pytest.approx(wanted, abs=0.02)  # 9.038 and 5.202 dB
    assert (losses == 0).mean() == pytest.approx(stats.norm.cdf(-mean / sigma), abs=2e-3)


def test_shadowing_correlates_exponentially_with_the_distance_moved():
    rng = np.random.default_rng(2)
    moved = np.array([0.0, 3.0, 7.0, 20.0])[:, None]
    process = budget.correlate_along_path(moved, np.full((4, 1), 10.0), rng.standard_normal((4, 400_000)))
    along = np.cumsum(moved[:, 0])
    wanted = np.exp(-np.abs(along[:, None] - along) / 10)
    np.testing.assert_allclose(np.cov(process), wanted, atol=6e-3)


def test_a_path_that_begins_anew_keeps_nothing_of_its_shadowing_and_one_that_rests_keeps_all():
    draws = np.array([[1.0], [-2.0], [0.5]])
    moved = np.array([[np.inf], [0.0], [np.inf]])
    assert budget.correlate_along_path(moved, np.full((3, 1), 13.0), draws)[:, 0].tolist() == [1.0, 1.0, 0.5]
