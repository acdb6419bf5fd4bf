"""Learning curves: published points refit, known curves recovered, outliers resisted."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import approx_fprime, curve_fit

from flcav.config import InputError
from flcav.optimization.curves.bands import bootstrap_bands, fit_upper_curve
from flcav.optimization.curves.fitting import explain_exponent, fit, fit_additive, fit_effective
from flcav.optimization.curves.forms import additive_forms, effective_forms, federated_forms
from flcav.optimization.curves.history import accumulate_resources, article_histories, parse_histories

PRINTED = {"weather": (11.84, 1.23), "signs": (8.15, 0.62), "objects": (0.51, 0.10)}  # a and b of the article


@pytest.mark.parametrize("name", PRINTED)
def test_the_articles_points_give_its_constants(name):
    points = article_histories()[name]
    samples, edge_rounds, cloud_rounds = points.resources.T
    whole = fit_additive(samples, edge_rounds, cloud_rounds, points.accuracy).curve
    assert (whole.pretrain.a, whole.pretrain.b) == pytest.approx(PRINTED[name], rel=0.03)
    assert whole.pretrain.x0 == 0
    assert whole.floor == 0


def test_a_history_that_never_changes_explains_nothing():
    samples = np.array([50.0, 100.0, 200.0, 400.0])
    fit = fit_additive(samples, np.zeros(4), np.zeros(4), np.full(4, 0.5))
    assert fit.r_squared is None
    assert "the same at all points" in " ".join(fit.warnings)


def test_effective_samples_are_recovered_up_to_what_can_be_told():
    samples, edge, cloud, _, noise = history()
    n = 0.1 * samples + 0.3 * 800 * (1 - 1 / (edge + 2 * cloud + 1))
    fit = fit_effective(samples, edge, cloud, 1 - 1.5 * n**-0.4 + 1e-5 * noise, group_samples=800, k=2)
    assert (fit.curve.alpha, fit.curve.beta) == pytest.approx((0.1, 0.3), rel=0.02)
    assert (fit.curve.a, fit.curve.b) == pytest.approx((1.5, 0.4), rel=0.02)


def test_beta_is_the_articles_where_rounds_never_vary():
    points = article_histories()["signs"]
    samples, edge_rounds, cloud_rounds = points.resources.T
    fit = fit_effective(samples, edge_rounds, cloud_rounds, points.accuracy, group_samples=7000)
    assert fit.curve.beta == 0.5
    assert fit.curve.b == pytest.approx(0.62, rel=0.03)


@pytest.mark.slow
def test_bands_hold_the_truth_about_as_often_as_they_say():
    rng = np.random.default_rng(1)
    x = np.geomspace(20, 3000, 9)
    asked = np.array([[50.0, 0, 0], [1000.0, 0, 0]])
    inside = []
    for _ in range(25):
        fit = fit_additive(x, 0 * x, 0 * x, 1 - 0.9 * x**-0.3 + rng.normal(0, 0.01, len(x)))
        found = bootstrap_bands(fit, level=0.8, repeats=40)
        assert found is not None
        low, high = found.between(asked)
        truth = 0.9 * asked[:, 0] ** -0.3
        inside += [(low <= truth) & (truth <= high)]
    assert 0.55 <= np.mean(inside) <= 0.95


def test_bands_are_seeded_and_the_upper_curve_is_above_them():
    points = article_histories()["objects"]
    samples, edge_rounds, cloud_rounds = points.resources.T
    fit = fit_additive(samples, edge_rounds, cloud_rounds, points.accuracy)
    found, again, other = (bootstrap_bands(fit, repeats=60, seed=seed) for seed in (3, 3, 4))
    assert found == again != other
    assert found is not None
    _, high = found.between(points.resources)
    assert np.all(fit_upper_curve(fit, found).error(samples, 0, 0) >= high - 1e-12)
    assert np.all(high > fit.curve.error(samples, 0, 0))


def test_two_points_have_no_band_and_say_so():
    fit = fit_additive([10, 100], [0, 0], [0, 0], [0.5, 0.7])
    assert bootstrap_bands(fit) is None
    assert "nothing is left to check" in fit.warnings[0]


LOGGED = {  # the last three rows are logged a second time, as after a resume
    "samples": [50, 200, 800, 3200, 3200, 3200, 3200, 3200, 50, 3200, 3200],
    "edge_rounds": [0, 0, 0, 0, 2, 8, 8, 8, 0, 0, 8],
    "cloud_rounds": [0, 0, 0, 0, 0, 0, 1, 4, 0, 0, 4],
    "error": [0.636, 0.577, 0.524, 0.488, 0.411, 0.369, 0.325, 0.304, 0.636, 0.488, 0.304],
}


@pytest.mark.slow
def test_rows_logged_twice_count_once_and_are_told() -> None:
    told = parse_histories(LOGGED, "runs.csv", "a")["a"]
    once = parse_histories({name: column[:8] for name, column in LOGGED.items()}, "runs.csv", "a")["a"]
    assert (told.repeats, once.repeats) == (3, 0)
    assert told.warnings == ("3 rows repeat an earlier one in every column and count once",)
    assert once.warnings == ()
    np.testing.assert_array_equal(told.resources, once.resources)
    assert fit(told).curve == fit(once).curve
    assert fit(told).rmse > 1e-3  # with repeats in the count of AICc the curve met every point
    others = parse_histories(LOGGED | {"seed": [1] * 8 + [1, 2, 1]}, "runs.csv", "a")["a"]
    assert (others.repeats, others.seeds.count("2")) == (2, 1)  # the same error of another seed is a measurement


def test_a_saturated_fit_has_no_band_whatever_counts_twice_or_nothing() -> None:
    x, accuracy = np.array([10.0, 100.0]), np.array([0.5, 0.7])
    repeated = fit_additive(np.tile(x, 6), [0] * 12, [0] * 12, np.tile(accuracy, 6))
    weights = [1, 1, 0, 0, 0, 0]
    weightless = fit_additive([*x, 20, 30, 40, 50], [0] * 6, [0] * 6, [*accuracy, 0.1, 0.9, 0.1, 0.9], weights)
    for found in (repeated, weightless):
        assert bootstrap_bands(found, repeats=20) is None
        assert "2 independent points for 2 parameters" in found.warnings[0]
        assert "the band is not known" in found.warnings[0]


def test_repeated_points_choose_no_richer_curve_and_leave_its_band_a_width() -> None:
    samples, edge, cloud, error = (np.tile(np.array(column[:8], dtype=float), 5) for column in LOGGED.values())
    found = fit_additive(samples, edge, cloud, 1 - error)
    assert found.fitted is not None
    assert (found.fitted.independent, len(found.fitted.parameters)) == (8, 6)
    band = bootstrap_bands(found, repeats=20)
    assert band is not None
    low, high = band.between(found.fitted.resources)
    assert np.all(high - low > 1e-3)


def test_what_lies_beyond_the_history_is_said():
    fit = fit_additive([10, 100, 1000], [0, 0, 0], [0, 0, 0], [0.5, 0.7, 0.8])
    assert fit.explain_extrapolation(900, 0, 0) is None
    assert "2000 samples (measured up to 1000)" in str(fit.explain_extrapolation(2000, 0, 0))
    assert "3 edge rounds (measured up to 0)" in str(fit.explain_extrapolation(10, 3, 0))
    assert fit.measured == {"samples": 1000}


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=4, max_size=9), st.integers(0, 100))
def test_whatever_the_points_the_curve_falls(accuracy, seed):
    x = np.sort(np.random.default_rng(seed).uniform(1, 3000, len(accuracy)))
    curve = fit_additive(x, 0 * x, 0 * x, accuracy).curve
    assert np.all(np.diff(curve.error(np.geomspace(1, 1e5, 60), 0, 0)) <= 0)


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
    (a, b), _ = curve_fit(lambda x, a, b: a * x**-b, x, 1 - accuracy, p0=(1, 0.3))
    assert np.abs(fit.curve.error(x, 0, 0) - truth).max() < 0.5 * np.abs(a * x**-b - truth).max() + 1e-3


def test_more_never_predicts_worse():
    samples, edge, cloud, accuracy, noise = history()
    curve = fit_additive(samples, edge, cloud, accuracy + 0.02 * noise).curve
    grid = np.arange(1, 5000, 7)
    assert np.all(np.diff(curve.error(grid, 1, 1)) <= 0)


def test_later_stages_stand_on_all_of_the_earlier_ones():
    rows = accumulate_resources(["pretrain", "pretrain", "edge", "cloud"], [10, 20, 3, 2])
    assert rows.tolist() == [[10, 0, 0], [20, 0, 0], [20, 3, 0], [20, 3, 2]]


def test_one_point_is_no_curve():
    with pytest.raises(InputError, match="at least 2"):
        fit_additive([10], [0], [0], [0.5])


def test_both_forms_of_a_history_say_the_same():
    long = {
        "task": ["a"] * 3,
        "stage": ["pretrain", "edge", "cloud"],
        "resource": [80, 6, 2],
        "accuracy": [0.5, 0.6, 0.7],
    }
    joint = {"samples": [80, 80, 80], "edge_rounds": [0, 6, 6], "cloud_rounds": [0, 0, 2], "accuracy": [0.5, 0.6, 0.7]}
    one, other = parse_histories(long, "long", "")["a"], parse_histories(joint, "joint", "runs")["runs"]
    np.testing.assert_array_equal(one.resources, other.resources)
    np.testing.assert_array_equal(one.accuracy, other.accuracy)


def test_an_error_is_one_minus_an_accuracy():
    joint = {"samples": [20, 100], "edge_rounds": [0, 0], "cloud_rounds": [0, 0]}
    told = parse_histories(joint | {"error": [0.5, 0.3]}, "t", "a")["a"]
    assert told.accuracy == pytest.approx([0.5, 0.7])
    long = {"task": ["a", "a"], "stage": ["pretrain", "pretrain"], "resource": [20, 100]}
    assert parse_histories(long | {"error": ["0.5", "0.3"]}, "t", "")["a"].accuracy == pytest.approx(told.accuracy)
    both = joint | {"error": [0.5, 0.342], "accuracy": [0.5, 0.659]}  # rounded .6585 and .3415
    assert parse_histories(both, "t", "a")["a"].accuracy.tolist() == [0.5, 0.659]
    with pytest.raises(InputError, match=r"row 2: accuracy = 0.3 and error = 0.3 do not sum to 1"):
        parse_histories(joint | {"error": [0.5, 0.3], "accuracy": [0.5, 0.3]}, "t", "a")
    with pytest.raises(InputError, match=r"row 1: error = 1.5 must be"):
        parse_histories(joint | {"error": [1.5, 0.3]}, "t", "a")
    with pytest.raises(InputError, match=r"'accuracy' is missing.*error may stand for accuracy"):
        parse_histories(joint, "t", "a")


def test_a_curve_too_small_to_compute_with_is_refused_in_a_sentence():
    rows = [[80, 160, 320, 320, 320], [0, 0, 0, 2, 6], [0] * 5, [0.4, 0.5, 0.6, 0.65, 0.7]]
    with pytest.raises(InputError, match=r"the fitted curve: field 'group_samples' = 5e-324: .*1e-100"):
        fit_effective(*rows, group_samples=5e-324)
    with pytest.raises(InputError, match=r"the fitted curve: field 'beta' = 1e-300"):
        fit_effective(*rows, group_samples=700, beta=1e-300)


@pytest.mark.filterwarnings("error")
def test_bands_are_infinite_where_the_error_is():
    found = fit_additive([10, 20, 40, 80, 160], [0] * 5, [0] * 5, [0.3, 0.42, 0.5, 0.61, 0.66])
    band = bootstrap_bands(found, repeats=20)
    assert band is not None
    low, high = band.between(np.array([[0.0, 0, 0], [100.0, 0, 0]]))
    assert (low[0], high[0]) == (np.inf, np.inf)
    assert 0 < low[1] <= high[1] < 1


@pytest.mark.parametrize(
    ("b", "said"),
    [
        (1e-6, "cloud: exponent 1e-06 is the least that is tried: it is not identified by this history"),
        (10 - 1e-9, "cloud: exponent 10 is the largest that is tried: it is not identified by this history"),
        (6.0, "hardly a power law"),
        (0.5, None),
    ],
)
def test_an_exponent_at_a_bound_of_the_search_is_not_identified(b: float, said: str | None) -> None:
    found = explain_exponent("cloud", b)
    assert found is None if said is None else found is not None and said in found


def test_derivatives_of_every_form_are_those_of_differences():
    resources = np.array([[s, e, c] for s in (20.0, 90.0, 400.0) for e in (0.0, 2.0, 5.0) for c in (0.0, 1.0, 3.0)])
    forms = (
        *additive_forms(resources),
        *effective_forms(resources, 0.1, None, 800.0, 2),
        *effective_forms(resources, 0.1, 0.4, 800.0, 2),
        *federated_forms(resources, 0.1, None, (30.0, 50.0), 2),
        *federated_forms(resources, 0.1, 0.4, (30.0, 50.0), 2),
    )
    assert len(forms) == 32 + 2 + 2 + 8 + 8
    for form in forms:
        for start in form.starts(0.4):
            p = 1.1 * np.array(start)
            differences = approx_fprime(p, lambda p, form=form: form.predict(p, resources), 1e-7)
            assert form.derivative(p, resources) == pytest.approx(differences, rel=1e-5, abs=1e-6), form
