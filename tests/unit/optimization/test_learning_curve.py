"""Learning curves: published points refit, known curves recovered, outliers resisted."""

import numpy as np
import pytest

from flcav.config import InputError
from flcav.optimization.history import resources_in_order
from flcav.optimization.learning_curve import fit_additive, fit_power

PUBLISHED = {
    "weather": (11.84, 1.23, {20: 0.703, 50: 0.903, 200: 0.983, 500: 0.998, 1000: 1.0, 2500: 1.0}),
    "signs": (8.15, 0.62, {50: 0.285, 200: 0.66, 500: 0.859, 1000: 0.89, 2500: 0.943}),
    "objects": (0.51, 0.10, {50: 0.659, 200: 0.710, 500: 0.716, 1000: 0.721, 2500: 0.793}),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_points_give_the_published_constants(name):
    a, b, points = PUBLISHED[name]
    resource, accuracy = list(points), list(points.values())
    zero = np.zeros(len(points))
    for decay in (fit_power(resource, accuracy), fit_additive(resource, zero, zero, accuracy).curve.pretrain):
        assert decay.a == pytest.approx(a, rel=0.03)
        assert decay.b == pytest.approx(b, rel=0.03)
        assert decay.x0 == 0


def history():
    rng = np.random.default_rng(0)
    samples = np.r_[np.geomspace(50, 3000, 12), np.full(16, 3000.0)]
    edge = np.r_[np.zeros(12), np.arange(1, 9), np.full(8, 8)]
    cloud = np.r_[np.zeros(20), np.arange(1, 9)]
    error = 0.05 + 1.2 * samples**-0.35 + 0.2 * (edge + 1.0) ** -0.6 + 0.1 * (cloud + 1.0) ** -0.9
    return samples, edge, cloud, 1 - error, rng.normal(0, 1, len(error))


def test_a_multi_stage_curve_is_recovered_where_it_was_measured():
    samples, edge, cloud, accuracy, noise = history()
    fit = fit_additive(samples, edge, cloud, accuracy + 1e-4 * noise)
    assert fit.rmse < 1e-3
    np.testing.assert_allclose(
        fit.curve.error(3000, [2, 5], 0), 1 - np.interp([2, 5], [2, 5], accuracy[[13, 16]]), atol=2e-3
    )


def test_an_outlier_moves_the_curve_less_than_it_moves_least_squares():
    x = np.geomspace(20, 4000, 16)
    truth = 0.9 * x**-0.3
    accuracy = 1 - truth
    accuracy[12] -= 0.3
    zero = np.zeros_like(x)
    fit = fit_additive(x, zero, zero, accuracy)
    plain = fit_power(x, accuracy)
    assert np.abs(fit.curve.error(x, 0, 0) - truth).max() < 0.5 * np.abs(plain.at(x) - truth).max() + 1e-3


def test_more_never_predicts_worse():
    samples, edge, cloud, accuracy, noise = history()
    curve = fit_additive(samples, edge, cloud, accuracy + 0.02 * noise).curve
    grid = np.arange(1, 5000, 7)
    assert np.all(np.diff(curve.error(grid, 1, 1)) <= 0)


def test_later_stages_stand_on_all_of_the_earlier_ones():
    rows = resources_in_order(["pretrain", "pretrain", "edge", "cloud"], [10, 20, 3, 2])
    assert rows.tolist() == [[10, 0, 0], [20, 0, 0], [20, 3, 0], [20, 3, 2]]


def test_one_point_is_no_curve():
    with pytest.raises(InputError, match="at least 2"):
        fit_additive([10], [0], [0], [0.5])
