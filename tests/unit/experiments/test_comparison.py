"""Means, differences and tables of arms over seeds, against numpy and the t interval of scipy."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import ttest_rel

from flcav.experiments.comparison import average_arms, compare_arms, tabulate_seeds, tabulate_verdicts
from flcav.statistics.seeds import mean_over_seeds

AP = {"before": (0.40, 0.42, 0.47), "after": (0.50, 0.51, 0.60)}
SEEDS = {str(n + 1): {arm: SimpleNamespace(ap=values[n]) for arm, values in AP.items()} for n in range(3)}


def test_arms_are_averaged_and_compared_in_pairs() -> None:
    means = average_arms(SEEDS, ("before", "after"), lambda arm: arm.ap)
    assert {arm: mean.mean for arm, mean in means.items()} == pytest.approx({arm: np.mean(AP[arm]) for arm in AP})
    (gain,) = compare_arms(SEEDS, [("after", "before")], lambda arm: arm.ap).items()
    tested = ttest_rel(AP["after"], AP["before"])
    assert gain[0] == "after - before"
    assert (gain[1].low, gain[1].high) == pytest.approx(tuple(tested.confidence_interval()))
    assert gain[1].p_value() == pytest.approx(tested.pvalue)


def test_tables_have_a_row_per_arm_and_per_claim() -> None:
    table = tabulate_seeds("AP50", SEEDS, ("after",), lambda arm: f"{arm.ap:.2f}")
    assert table.splitlines() == [
        "| AP50 | seed 1 | seed 2 | seed 3 |",
        "|---|---|---|---|",
        "| after | 0.50 | 0.51 | 0.60 |",
    ]
    claims = {("grid", "all"): mean_over_seeds([0.1, 0.11, 0.12]), ("ring", "all"): mean_over_seeds([0.1, -0.3, 0.2])}
    heads, _, held, undecided = tabulate_verdicts(("town", "who"), "gain", claims).splitlines()
    assert heads.startswith("| town | who | gain | p, corrected | claim that it is positive | if undecided")
    assert held.startswith("| grid | all | +0.110 (+0.085 to +0.135) |")
    assert held.endswith("| held | |")
    assert "| undecided | " in undecided
