"""Intervals, corrected verdicts and numbers of seeds against simulations."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.special import stdtrit

from flcav.statistics.bootstrap import share_scenes
from flcav.statistics.power import plan_seeds, power_of_seeds, seeds_to_tell
from flcav.statistics.seeds import OWN_SCENES, MeanOverSeeds, SharedScenes, half_width, mean_over_seeds
from flcav.statistics.verdicts import (
    HELD,
    NOT_HELD,
    UNDECIDED,
    Claim,
    correct_p_values,
    describe_aims,
    format_p,
    judge,
)

Array = NDArray[np.float64]
SCENES, TRUTH = 12, 0.9
PLANTED = [(0.02, 0.03, 0.03), (0.005, 0.04, 0.02), (0.02, 0.01, 0.01)]  # sd of seeds, scenes, seeds in scenes


def scores(rng: np.random.Generator, seeds: int, crossed: bool, planted: tuple[float, float, float]) -> Array:
    """Return (seeds, SCENES) scores of trainings with planted spreads; `crossed`: all seeds have the same scenes."""
    of_seed, of_scene, both = planted
    trained = rng.normal(0, of_seed, (seeds, 1))
    met = rng.normal(0, of_scene, (1 if crossed else seeds, SCENES))
    return TRUTH + trained + met + rng.normal(0, both, (seeds, SCENES))


def weighted(values: Array) -> Callable[[NDArray[np.int64]], Array]:
    def mean(times: NDArray[np.int64]) -> Array:
        with np.errstate(invalid="ignore"):
            return times @ values / times.sum(axis=1)

    return mean


def ours(rng: np.random.Generator, table: Array, crossed: bool, share: bool) -> MeanOverSeeds:
    names = [[f"{0 if crossed else seed}-{scene}" for scene in range(SCENES)] for seed in range(len(table))]
    shared = share_scenes([weighted(row) for row in table], names, 100, rng=rng)
    assert shared.scenes == (SCENES if crossed else 0)
    return mean_over_seeds(table.mean(axis=1).tolist(), shared=shared, share=share)


def coverage(seeds: int, crossed: bool, planted: tuple[float, float, float], share: bool, times: int = 2500) -> float:
    rng, hits = np.random.default_rng(seeds), 0
    for _ in range(times):
        found = ours(rng, scores(rng, seeds, crossed, planted), crossed, share)
        assert found.low is not None
        assert found.high is not None
        hits += found.low <= TRUTH <= found.high
    return hits / times


@pytest.mark.slow
@pytest.mark.parametrize("planted", PLANTED)
@pytest.mark.parametrize("crossed", [False, True], ids=["own scenes", "shared scenes"])
@pytest.mark.parametrize("seeds", [3, 5, 8])
def test_intervals_contain_the_truth_in_95_of_100_repetitions(seeds: int, crossed: bool, planted) -> None:
    assert 0.93 <= coverage(seeds, crossed, planted, share=True) <= 0.97


@pytest.mark.slow
def test_numbers_that_are_no_shares_are_covered_as_often() -> None:
    assert 0.93 <= coverage(3, False, PLANTED[0], share=False) <= 0.97
    assert 0.93 <= coverage(3, True, PLANTED[0], share=False) <= 0.97


def test_other_methods_cover_too_little_or_too_much() -> None:
    """Resampling seeds and then scenes counts the spread of scenes twice; percentiles of three seeds are too narrow."""
    rng, planted, times, draws = np.random.default_rng(0), PLANTED[0], 1000, 200
    percentile, doubled, by_seeds = 0, 0, 0
    for _ in range(times):
        own = scores(rng, 3, False, planted)
        seeds, scenes = rng.integers(0, 3, (draws, 3, 1)), rng.integers(0, SCENES, (draws, 3, SCENES))
        means = own[seeds, scenes].mean(axis=(1, 2))
        low, high = np.quantile(means, (0.025, 0.975))
        percentile += low <= TRUTH <= high
        half = stdtrit(2, 0.975) * means.std(ddof=1) * np.sqrt(3 / 2)
        doubled += abs(own.mean() - TRUTH) <= half
        common = scores(rng, 3, True, PLANTED[1]).mean(axis=1)
        by_seeds += abs(common.mean() - TRUTH) <= stdtrit(2, 0.975) * common.std(ddof=1) / np.sqrt(3)
    assert percentile / times < 0.93
    assert doubled / times > 0.97
    assert by_seeds / times < 0.93  # Student's t alone where seeds share their scenes


def test_shared_scenes_have_the_spread_that_was_planted() -> None:
    rng, of_scene, found = np.random.default_rng(1), 0.04, []
    for table in (scores(rng, 4, True, (0.03, of_scene, 0.03)) for _ in range(300)):
        found.append(share_scenes([weighted(row) for row in table], [np.arange(SCENES)] * 4, 300, rng=rng).sd ** 2)
    assert np.mean(found) == pytest.approx(of_scene**2 / SCENES, rel=0.12)
    assert share_scenes([weighted(np.ones(2))] * 2, [list("ab"), list("cd")], rng=rng) is OWN_SCENES


def test_own_scenes_give_the_interval_and_the_p_value_of_a_t_test() -> None:
    values = [0.71, 0.78, 0.69, 0.74]
    theirs: Any = stats.ttest_1samp(values, 0.7)
    wanted = theirs.confidence_interval(0.95)
    found = mean_over_seeds(values)
    assert (found.mean, found.low, found.high) == pytest.approx((0.73, wanted.low, wanted.high))
    assert found.p_value(0.7) == pytest.approx(theirs.pvalue)
    assert found.sd == pytest.approx(stats.tstd(values))
    assert half_width(found.sd, 4) == pytest.approx(0.73 - wanted.low)


def test_one_seed_and_shares_without_spread_have_no_interval() -> None:
    single = mean_over_seeds([0.7])
    assert (single.mean, single.low, single.high, single.p_value(), seeds_to_tell(single)) == (0.7, *[None] * 4)
    full = mean_over_seeds([1.0, 1.0, 1.0], share=True)
    assert (full.low, full.high, full.p_value(0.9)) == (None, None, None)


@pytest.mark.parametrize("values", [[0.9, 1.0, 1.0], [0.02, 0.0, 0.001], [0.999, 0.97, 0.995]])
def test_the_interval_of_a_share_stays_inside_0_and_1_and_decides_as_its_p_value(values: list[float]) -> None:
    for shared in (OWN_SCENES, SharedScenes(0.01, 10)):
        found = mean_over_seeds(values, shared=shared, share=True)
        assert found.low is not None
        assert found.high is not None
        assert 0 < found.low < found.mean < found.high < 1
        for end in (found.low, found.high):
            assert found.p_value(end) == pytest.approx(0.05, abs=1e-6)


def test_holm_corrects_as_by_hand() -> None:
    """Sorted: 4 x 0.005, 3 x 0.01, 2 x 0.03, 1 x 0.04; a corrected value is at least the one before it."""
    assert correct_p_values([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert correct_p_values([0.6, 0.7]) == [1.0, 1.0]
    assert correct_p_values([]) == []


@pytest.mark.slow
def test_a_page_of_true_hypotheses_has_a_wrong_verdict_in_at_most_one_of_twenty() -> None:
    rng, wrong, uncorrected, pages = np.random.default_rng(2), 0, 0, 1500
    for _ in range(pages):
        values = rng.normal(size=(8, 5)) + rng.normal(size=5)  # claims of the same seeds are correlated
        claims = [Claim(mean_over_seeds(row.tolist())) for row in values]
        wrong += any(each.verdict != UNDECIDED for each in judge(claims))
        uncorrected += any((claim.mean.p_value() or 0) < 0.05 for claim in claims)
    assert wrong / pages <= 0.06
    assert uncorrected / pages > 0.15


def test_verdicts_name_the_side_and_unknown_spreads_do_not_count() -> None:
    high, low = mean_over_seeds([0.5, 0.51, 0.505]), mean_over_seeds([-0.5, -0.51, -0.505])
    wide, single = mean_over_seeds([0.5, -0.4, 0.2]), mean_over_seeds([0.5])
    found = judge([Claim(high), Claim(low), Claim(low, at_most=True), Claim(wide), Claim(single)])
    assert [each.verdict for each in found] == [HELD, NOT_HELD, HELD, UNDECIDED, UNDECIDED]
    assert {each.family for each in found} == {4}
    assert found[4].p is None
    assert found[4].describe() == "the spread over seeds is not known"
    assert found[0].describe() == "p < 0.001, corrected for 4 claims"
    assert f"detecting an effect of this size takes about {found[3].seeds} seeds" in found[3].describe()
    assert (format_p(0.0004), format_p(0.0404)) == ("< 0.001", "0.040")


def test_an_undecided_claim_takes_more_seeds_than_it_has() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        seeds = int(rng.integers(2, 9))
        claims = [Claim(mean_over_seeds(row.tolist())) for row in rng.normal(0.7, 1, (5, seeds))]
        for each in judge(claims):
            if each.verdict == UNDECIDED:
                assert each.seeds is None or each.seeds > seeds


@pytest.mark.parametrize(("effect", "seeds"), [(0.2, 199), (0.5, 34), (0.8, 15), (1.0, 10)])
def test_planned_seeds_are_those_of_published_tables(effect: float, seeds: int) -> None:
    """Paired t test, two-sided, level 0.05, power 0.8: G*Power (Faul et al., Behavior Research Methods 39, 2007)."""
    assert plan_seeds(effect, 1.0) == seeds
    assert plan_seeds(-0.02 * effect, 0.02) == seeds


def test_seeds_for_a_share_are_planned_on_the_scale_of_its_test() -> None:
    """Near 0.5 log-odds are linear; near 1 a lower value is nearer, in units of the spread."""
    middle, high = [0.50, 0.52, 0.48], [0.96, 0.98, 0.94]
    for values, hypothesis, same in ((middle, 0.51, True), (high, 0.94, False)):
        share, plain = (seeds_to_tell(mean_over_seeds(values, share=each), hypothesis) for each in (True, False))
        assert share is not None
        assert plain is not None
        assert (share == plain) == same
        assert share >= plain


def test_a_larger_effect_never_takes_more_seeds() -> None:
    """Also where the noncentral t distribution is next to 0, which SciPy gives as not a number."""
    for sd in (0.002, 0.0056, 0.01, 0.02):
        seeds = [plan_seeds(effect, sd) or 10**6 for effect in np.arange(0.005, 0.08, 0.0025)]
        assert seeds == sorted(seeds, reverse=True)


def test_power_is_that_of_simulated_tests() -> None:
    rng = np.random.default_rng(4)
    for effect, seeds, level in ((0.9, 5, 0.05), (1.5, 8, 0.05 / 6), (6.0, 3, 0.05)):
        tests: Any = stats.ttest_1samp(rng.normal(effect, 1, (20_000, seeds)), 0.0, axis=1)
        assert power_of_seeds(effect, 1.0, seeds, level) == pytest.approx(np.mean(tests.pvalue < level), abs=0.012)
    assert power_of_seeds(0.01, 0.0, 2) == 1.0


def test_shared_scenes_limit_what_seeds_can_tell() -> None:
    assert plan_seeds(0.02, 0.02, shared=SharedScenes(0.02, 12)) is None
    few, more = plan_seeds(0.02, 0.02), plan_seeds(0.02, 0.02, shared=SharedScenes(0.004, 12))
    assert few is not None
    assert more is not None
    assert few < more


@pytest.mark.parametrize(
    ("values", "at_most", "said"),
    [
        ((0.9, 0.91, 0.92), False, "reached"),
        ((0.7, 0.71, 0.72), False, "not reached"),
        ((0.8, 0.9), False, "undecided"),
        ((0.7, 0.71, 0.72), True, "reached"),
        ((0.9, 0.91, 0.92), True, "not reached"),
        ((0.9,), False, "undecided"),
    ],
)
def test_an_aim_is_reached_where_its_corrected_p_says_so(values: tuple[float, ...], at_most: bool, said: str) -> None:
    mean = mean_over_seeds(values)
    (sentence,) = describe_aims({"AP of 0.85": Claim(mean, 0.85, at_most)})
    assert sentence.startswith(f"*AP of 0.85*: **{said}**, {mean.describe()} o")
    assert ("of one seed" if len(values) == 1 else f"over {len(values)} seeds of standard deviation") in sentence
