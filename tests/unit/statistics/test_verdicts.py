import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.special import expit, logit

from flcav.statistics.estimates import Estimate, Spread
from flcav.statistics.power import plan_sample, seeds_to_tell
from flcav.statistics.seeds import LARGEST_SPREAD, SharedScenes, mean_over_seeds, of_one_training
from flcav.statistics.verdicts import (
    HELD,
    NOT_HELD,
    UNDECIDED,
    Claim,
    explain_verdict,
    judge,
    judge_known,
    signed,
    tell_loss,
    verdict,
)

CLEAR, OPEN = [0.02, 0.03, 0.035, 0.01], [0.02, -0.03, 0.035, -0.01]


def ttest(values: list[float]) -> float:
    theirs: Any = stats.ttest_1samp(values, 0.0)
    return theirs.pvalue


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (0.01, 0.02, HELD),
        (-0.02, -0.01, NOT_HELD),
        (-0.01, 0.02, UNDECIDED),
        (0.0, 0.02, UNDECIDED),
        (-1, 0, UNDECIDED),
    ],
)
def test_only_an_interval_without_zero_decides(low: float, high: float, said: str) -> None:
    assert verdict(low, high) == said


def test_without_an_interval_nothing_is_decided() -> None:
    assert verdict(None, None) == UNDECIDED


def test_a_claim_without_a_known_spread_counts_in_no_family() -> None:
    training = of_one_training(Estimate(0.06, 0.022, 0.11), 30, Spread(0.012, 9))
    assert training is not None
    alone, unknown = judge_known([Claim(training), None])
    assert (alone, unknown) == (judge([Claim(training)])[0], None)
    assert alone is not None
    assert alone.verdict == HELD
    assert [one.verdict for one in judge([Claim(training)] * 5)] == [UNDECIDED] * 5


def test_the_words_say_what_was_decided():
    assert explain_verdict(UNDECIDED) == "the result is inconclusive"
    assert explain_verdict(NOT_HELD) == "the claim did not hold in this run"
    assert (signed(-0.0125), signed(2, 1)) == ("−0.013", "+2.0")


def test_a_claim_that_its_own_interval_decides_alone_is_told_with_its_simultaneous_interval() -> None:
    mean = mean_over_seeds(CLEAR)
    assert mean.low is not None
    assert mean.low > 0
    first, *_ = judge([Claim(mean), *[Claim(mean_over_seeds(OPEN))] * 4])
    half = stats.t.ppf(1 - 0.01 / 2, 3) * np.std(CLEAR, ddof=1) / 2
    assert first.verdict == UNDECIDED
    assert first.alone is not None
    assert first.alone.p == mean.p_value()
    assert first.alone.ends == pytest.approx((mean.mean - half, mean.mean + half))
    low, high = (signed(end) for end in first.alone.ends)
    p = ttest(CLEAR)
    told = f" ({p:.3f} alone; simultaneous interval {low} to {high})"
    assert first.p_cell == f"{5 * p:.3f}{told}"
    seeds = seeds_to_tell(mean, level=0.01)
    takes = f"detecting an effect of this size takes about {seeds} seeds"
    assert first.describe() == f"p {5 * p:.3f}, corrected for 5 claims{told}; {takes}"
    assert first.takes_cell == str(seeds)


def test_what_is_decided_or_open_anyway_has_no_simultaneous_interval() -> None:
    decided, open_ = judge([Claim(mean_over_seeds([0.5, 0.51, 0.505])), Claim(mean_over_seeds(OPEN))])
    assert (decided.verdict, decided.alone, decided.size, decided.takes_cell) == (HELD, None, None, "")
    assert (open_.verdict, open_.alone) == (UNDECIDED, None)
    assert (decided.p_cell, open_.p_cell) == ("< 0.001", f"{ttest(OPEN):.3f}")
    single = judge([Claim(mean_over_seeds([0.5]))])[0]
    assert (single.p_cell, single.takes_cell) == ("", "")


def test_a_simultaneous_interval_of_a_share_is_on_its_scale_and_that_of_one_training_has_both_sources() -> None:
    values = [0.9, 0.92, 0.95]
    share = mean_over_seeds(values, share=True)
    slope = 1 / (share.mean * (1 - share.mean))
    half = stats.t.ppf(1 - 0.01 / 2, 2) * np.std(values, ddof=1) / np.sqrt(3) * slope
    assert share.ends(0.01) == pytest.approx(tuple(expit(logit(share.mean) + half * np.array([-1, 1]))))
    training = of_one_training(Estimate(0.06, 0.022, 0.11), 30, Spread(0.012, 9))
    assert training is not None
    trained = stats.t.ppf(1 - 0.01 / 2, 8) * 0.012
    below, above = (side * stats.norm.ppf(1 - 0.01 / 2) / stats.norm.ppf(0.975) for side in (0.038, 0.05))
    assert training.ends(0.01) == pytest.approx((0.06 - np.hypot(below, trained), 0.06 + np.hypot(above, trained)))
    assert training.ends() == pytest.approx((training.low, training.high))
    p_value = training.p_value()
    assert training.ends(p_value)[0] == pytest.approx(0.0, abs=1e-9)


def test_an_undecided_claim_on_shared_scenes_tells_trainings_and_scenes() -> None:
    mean = mean_over_seeds(OPEN, shared=SharedScenes(0.003, 20))
    (found,) = judge([Claim(mean)])
    assert found.size == plan_sample(mean, 0.0, 0.05)
    assert found.size is not None
    assert found.takes_cell == found.size.describe("seeds")
    assert found.describe("trainings").endswith(f"of this size takes {found.size.describe('trainings')}")


def draw_differences(rng: np.random.Generator, times: int, scenes: int, gain: float, spread: float) -> np.ndarray:
    """Return (times, scenes) differences of an accuracy: of each scene its own, with that of the training."""
    mean = gain + rng.normal(0, spread, (times, 1))
    before, after = rng.beta(1, 1, (times, scenes)), rng.beta(1, 1, (times, scenes))
    frames = 4
    return rng.binomial(frames, np.clip(after + mean, 0, 1)) / frames - rng.binomial(frames, before) / frames


@pytest.mark.parametrize("scenes", [6, 8, 16, 32])
def test_trainings_without_a_loss_are_rarely_called_one_and_collapses_nearly_always(scenes: int) -> None:
    """The spread of these trainings is the largest that is assumed; a collapse is from .82 to 0 in every scene."""
    rng, called = np.random.default_rng(scenes), {}
    collapsed = -rng.binomial(4, np.clip(rng.normal(0.82, 0.2, (300, scenes)), 0, 1)) / 4
    for name, drawn in (
        ("none", draw_differences(rng, 2000, scenes, 0.0, LARGEST_SPREAD)),
        ("gain", draw_differences(rng, 500, scenes, 0.1, LARGEST_SPREAD)),
        ("collapse", collapsed),
    ):
        times = rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=200)
        low, high = np.quantile(drawn @ times.T / scenes, [0.025, 0.975], axis=1)
        found = zip(drawn.mean(axis=1).tolist(), low.tolist(), high.tolist(), strict=True)
        called[name] = np.mean([tell_loss(Estimate(*each), scenes, 1) is not None for each in found])
    print(scenes, called)
    assert called["none"] <= 0.03  # one side of 5 %
    assert called["gain"] <= 0.01
    assert called["collapse"] >= 0.99


def test_a_paired_interval_far_below_0_is_a_loss_though_the_spread_is_not_known() -> None:
    collapse = Estimate(-0.734, -0.906, -0.547)
    for scenes, family in ((6, 4), (8, 8), (32, 20)):
        assert tell_loss(collapse, scenes, family) is not None
    assert tell_loss(collapse, 5, 1) is None, "of few scenes all may be those that it fails in"
    assert tell_loss(Estimate(0.734, 0.547, 0.906), 32, 1) is None, "a gain of one training is not claimed"
    assert tell_loss(Estimate(-0.15, -0.2, -0.1), 32, 1) is None, "another training may differ by as much"
    assert tell_loss(Estimate(-0.734, None, None), 32, 1) is None


def test_the_spread_that_is_assumed_is_above_all_that_were_measured() -> None:
    found = []
    for path in sorted((Path(__file__).parents[3] / "reproductions").rglob("results.json")):
        for each in json.loads(path.read_text()).get("differences", []):
            if isinstance(each, dict) and each.get("spread"):
                found.append(each["spread"]["sd"])
    assert len(found) > 50
    assert max(found) < LARGEST_SPREAD
