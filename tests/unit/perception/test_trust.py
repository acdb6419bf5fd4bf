"""Slices of average precision, and calibration against its definition and scikit-free oracles."""

import numpy as np
import pytest
from scipy.special import expit, logit

from flcav.geometry import Boxes
from flcav.perception.metrics import calibration_error, fit_logistic
from flcav.perception.objects.evaluate import break_down, format_breakdown, score_detections
from flcav.perception.objects.predict import measure_reliability
from flcav.perception.objects.truth import FrameTruth


def cars(*xs, scores=None):
    rows = np.array([(x, 0.0, 0.0, 4.0, 1.8, 1.5, 0.0) for x in xs]).reshape(-1, 7)
    return Boxes.from_array(rows, "Car", scores)


def test_error_of_calibration_by_hand():
    assert calibration_error([0.95, 0.95, 0.15, 0.15], [1, 0, 0, 0]) == pytest.approx((0.9 + 0.3) / 4)
    assert calibration_error([1.0], [1]) == 0
    assert np.isnan(calibration_error([], []))


def test_scores_that_are_too_sure_are_put_right():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.05, 0.95, 20_000)
    hit = rng.random(len(truth)) < truth
    shown = expit(2 * logit(truth) + 1)
    factor, summand = fit_logistic(shown, hit)
    assert (factor, summand) == pytest.approx((0.5, -0.5), abs=0.03)
    assert calibration_error(expit(factor * logit(shown) + summand), hit) < 0.01 < calibration_error(shown, hit)


def test_nothing_changes_where_there_is_nothing_to_learn():
    assert fit_logistic([0.2, 0.9], [1, 1]) == (1.0, 0.0)
    assert fit_logistic([], []) == (1.0, 0.0)


def truth(*xs, occlusion, weather: str | None = "clear", neutral=()):
    return FrameTruth("s", cars(*xs), cars(*neutral), Boxes.empty(), np.array(occlusion, dtype=float), weather)


def row(rows, by, name, kind="3d", iou=0.5):
    (found,) = [r for r in rows if (r.by, r.slice, r.kind, r.iou) == (by, name, kind, iou)]
    return found.ap, found.targets


def test_slices_ask_for_their_own_objects_and_for_no_others():
    truths = [truth(10, 30, 50, occlusion=(0, 0.5, 0.9))]
    found = [cars(10, 30, scores=[0.9, 0.8])]
    rows = break_down(found, truths, ("Car",))
    assert row(rows, "distance", "0-20 m") == (1, 1)
    assert row(rows, "distance", "20-40 m") == (1, 1)
    assert row(rows, "distance", "40-80 m") == (0, 1)
    assert row(rows, "occlusion", "0%-20%") == (1, 1)
    assert row(rows, "occlusion", "60%-100%") == (0, 1)
    assert not [r for r in rows if r.by == "weather"]


def test_a_false_positive_counts_in_the_slice_of_its_distance():
    rows = break_down([cars(10, 15, scores=[0.8, 0.9])], [truth(10, 30, occlusion=(0, 0))], ("Car",))
    assert row(rows, "distance", "0-20 m") == (0.5, 1)
    assert row(rows, "distance", "20-40 m") == (0, 1)


def test_weathers_are_told_apart_where_there_are_several():
    truths = [truth(10, occlusion=(0,)), truth(10, occlusion=(0,), weather="fog")]
    rows = break_down([cars(10, scores=[0.9]), cars()], truths, ("Car",))
    assert row(rows, "weather", "clear") == (1, 1)
    assert row(rows, "weather", "fog") == (0, 1)
    assert format_breakdown(rows, 0.5)[-1] == "Car         weather    fog         AP 3d 0.000  bev 0.000  (objects: 1)"


def test_a_weather_s_slice_is_the_evaluation_of_its_frames():
    rng, names = np.random.default_rng(0), ("clear", "fog", "night")
    places = [np.sort(rng.choice(np.arange(5, 60, 6), 4, replace=False)) for _ in range(12)]
    truths = [truth(*xs, occlusion=(0,) * 4, weather=names[i % 3]) for i, xs in enumerate(places)]
    found = [cars(*xs[:3] + rng.normal(0, 0.7, 3), 70.0, scores=rng.random(4)) for xs in places]
    rows = break_down(found, truths, ("Car",))
    for number, name in enumerate(names):
        alone = score_detections(found[number::3], truths[number::3], ("Car",))[0].ap
        assert alone is not None
        assert 0 < alone < 1
        assert row(rows, "weather", name) == (pytest.approx(alone, abs=1e-6), 16)


def test_weathers_come_in_the_order_of_their_classes():
    names = ("night", "heavy_rain", None, "clear")
    rows = break_down([cars()] * 4, [truth(10, occlusion=(0,), weather=name) for name in names], ("Car",))
    assert list(dict.fromkeys(r.slice for r in rows if r.by == "weather")) == ["clear", "heavy_rain", "night"]


def test_variances_are_judged_by_the_errors_they_foretell():
    found = cars(10.2, 30.2, scores=[0.9, 0.9])
    variance = np.full((2, 7), 0.02)
    found = Boxes(found.center, found.size, found.yaw, found.label, found.score, variance)
    (said,) = measure_reliability([found], [truth(10, 30, occlusion=(0, 0))], ("Car",))
    assert said.variance_ratio == pytest.approx(0.04 / 0.04, abs=1e-6)
    assert said.ece == pytest.approx(0.1)
    assert said.detections == 2
