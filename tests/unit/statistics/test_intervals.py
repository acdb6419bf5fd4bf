"""Intervals against SciPy's own bootstrap and against redrawings one by one."""

import numpy as np
import pytest
from scipy import stats

from flcav.statistics.bootstrap import bootstrap_over_scenes
from flcav.statistics.estimates import (
    Estimate,
    Spread,
    combine_spreads,
    measure_spread,
    pool_spreads,
    score_interval,
    widen,
    widen_share,
)
from flcav.statistics.power import seeds_to_tell
from flcav.statistics.seeds import of_one_training


def test_the_interval_over_scenes_is_that_of_redrawing_them_one_by_one():
    rng = np.random.default_rng(0)
    scenes, right = np.repeat(["b", "a", "c", "d"], [5, 8, 2, 9]), rng.random(24) < 0.7
    low, high = bootstrap_over_scenes(
        lambda times: times @ right / times.sum(axis=1), scenes, 400, rng=np.random.default_rng(3)
    )
    own, one_by_one = np.random.default_rng(3), []
    for counts in own.multinomial(4, np.full(4, 0.25), size=400):
        drawn = np.concatenate([np.tile(right[scenes == name], count) for name, count in zip("abcd", counts)])
        one_by_one.append(drawn.mean())
    assert (low, high) == pytest.approx(tuple(np.quantile(one_by_one, (0.025, 0.975))), abs=1e-12)


def test_scenes_of_one_frame_give_the_bootstrap_of_scipy():
    values = np.random.default_rng(1).normal(size=60)
    found = bootstrap_over_scenes(
        lambda times: times @ values / len(values), np.arange(60), 20_000, rng=np.random.default_rng(2)
    )
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(4)
    ).confidence_interval
    assert found == pytest.approx((theirs.low, theirs.high), abs=0.01)


def test_what_no_redrawing_knows_has_no_interval_and_unknown_ones_are_left_out():
    rng = np.random.default_rng(0)
    assert np.isnan(bootstrap_over_scenes(lambda times: np.full(len(times), np.nan), "ab", 50, rng=rng)).all()
    known = bootstrap_over_scenes(lambda times: np.where(times[:, 0] > 0, 1.0, np.nan), list("ab"), 50, rng=rng)
    assert known == (1.0, 1.0)


def test_an_estimate_is_told_with_its_interval_where_it_has_one():
    assert Estimate(0.1, -0.2, 0.4).describe() == "0.100 (-0.200 to 0.400)"
    assert Estimate(0.1, -0.2, 0.4).describe(sign=True) == "+0.100 (-0.200 to +0.400)"
    assert Estimate(0.1, None, None).describe() == "0.100"


def test_the_spread_is_the_standard_deviation_of_several_trainings():
    values = [0.61, 0.66, 0.58]
    found = measure_spread(values)
    assert found is not None
    assert (found.sd, found.trainings) == (pytest.approx(stats.tstd(values)), 3)
    assert measure_spread([0.6]) is None


def test_pooled_spreads_are_those_of_trainings_around_their_own_means():
    rng = np.random.default_rng(3)
    sets = [rng.normal(mean, 0.03, size) for mean, size in ((0.2, 4000), (0.7, 9000))]
    found = pool_spreads([Spread(float(each.std(ddof=1)), len(each)) for each in sets])
    around = np.concatenate([each - each.mean() for each in sets])
    assert (found.sd, found.trainings) == (pytest.approx(around.std(ddof=2)), len(around) - 1)


def test_a_difference_spreads_by_both_trainings():
    rng = np.random.default_rng(7)
    first, second = rng.normal(scale=0.03, size=50_000), rng.normal(scale=0.04, size=50_000)
    found = combine_spreads(Spread(0.03, 9), Spread(0.04, 5))
    assert found is not None
    assert (found.sd, found.trainings) == (pytest.approx((first - second).std(), rel=0.02), 5)
    assert combine_spreads(Spread(0.03, 9), None) is None


def test_widened_intervals_contain_the_mean_over_trainings_and_scenes_as_often_as_they_say():
    rng, hit, narrow = np.random.default_rng(5), [], []
    for _ in range(4000):
        scenes, trained = rng.normal(scale=0.02), rng.normal(scale=0.03, size=10)
        of_scenes = Estimate(scenes + trained[0], scenes + trained[0] - 1.96 * 0.02, scenes + trained[0] + 1.96 * 0.02)
        found = widen(of_scenes, Spread(float(trained[1:].std(ddof=1)), 9))
        assert found.low is not None
        assert found.high is not None
        hit.append(found.low <= 0 <= found.high)
        narrow.append(abs(of_scenes.mean) <= 1.96 * 0.02)
    assert np.mean(hit) == pytest.approx(0.95, abs=0.015)
    assert np.mean(narrow) < 0.8


@pytest.mark.parametrize("mean", [0.02, 0.5, 0.97])
def test_a_widened_share_stays_a_share_and_agrees_with_the_plain_one_in_the_middle(mean: float):
    estimate, spread = Estimate(mean, mean - 0.015, mean + 0.015), Spread(0.02, 9)
    found = widen_share(estimate, spread)
    assert found.low is not None
    assert found.high is not None
    assert 0 < found.low < mean - 0.015
    assert mean + 0.015 < found.high < 1
    if mean == 0.5:
        plain = widen(estimate, spread)
        assert (found.low, found.high) == pytest.approx((plain.low, plain.high), abs=0.001)
    assert widen_share(Estimate(1.0, 1.0, 1.0), spread) == Estimate(1.0, 1.0, 1.0)
    assert widen(Estimate(0.3, None, None), spread) == Estimate(0.3, None, None)


def test_the_p_value_of_one_training_is_that_of_its_sources_alone_and_of_its_interval():
    """Scenes alone give the normal test, trainings alone Student's t with the freedom of their spread."""
    scenes, still = Estimate(0.05, 0.01, 0.08), Spread(0.0, 8)
    alone = of_one_training(scenes, 30, still)
    assert alone is not None
    assert alone.p_value() == pytest.approx(2 * stats.norm.sf(0.05 / (0.04 / stats.norm.ppf(0.975))), rel=1e-6)
    trained = of_one_training(Estimate(0.05, 0.05, 0.05), 30, Spread(0.02, 8))
    assert trained is not None
    assert trained.p_value() == pytest.approx(2 * stats.t.sf(0.05 / 0.02, 7), rel=1e-6)
    ends = float(np.hypot(0.04, stats.t.ppf(0.975, 7) * 0.02))
    both = of_one_training(Estimate(ends, ends - 0.04, ends + 0.01), 30, Spread(0.02, 8))
    assert both is not None
    assert (both.low, both.p_value()) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.05, rel=1e-6))
    below = of_one_training(Estimate(-ends, -ends - 0.01, -ends + 0.04), 30, Spread(0.02, 8))
    assert below is not None
    assert (below.high, below.p_value()) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.05, rel=1e-6))
    assert of_one_training(Estimate(0.1, None, None), 1, still) is None
    same = of_one_training(Estimate(0.0, 0.0, 0.0), 30, still)
    assert same is not None
    assert (same.p_value(), same.p_value(0.1)) == (1.0, 0.0)


def test_more_trainings_of_one_run_tell_what_its_scenes_allow():
    found = of_one_training(Estimate(0.05, 0.03, 0.07), 100, Spread(0.04, 8))
    assert found is not None
    few, many = seeds_to_tell(found), seeds_to_tell(found, level=0.01)
    assert few is not None
    assert many is not None
    assert 5 < few < many, "of trainings alone it takes 8 by the tables of the paired t test"
    blurred = of_one_training(Estimate(0.05, 0.0, 0.1), 100, Spread(0.04, 8))
    assert blurred is not None
    assert seeds_to_tell(blurred) is None


@pytest.mark.parametrize(("right", "trials"), [(7, 7), (0, 12), (30, 33)])
def test_the_score_interval_is_that_of_scipy(right: int, trials: int):
    theirs = stats.binomtest(right, trials).proportion_ci(method="wilson")
    found = score_interval(right / trials, trials)
    assert (found.low, found.high) == pytest.approx((theirs.low, theirs.high))
