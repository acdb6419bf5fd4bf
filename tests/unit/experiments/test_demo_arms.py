import numpy as np
import pytest
from scipy import stats

from flcav.experiments.demo_arms import arm_steps, arms_protocol, summarise


def seed(ap: float) -> dict:
    arms = {"pretrained": {"ap50": ap, "ap70": ap / 2}, "edge FL": {"ap50": ap + 0.1, "ap70": ap / 2}}
    return {
        "ap": {"grid": arms},
        "differences": {"grid: edge FL - pretrained": {"mean": 0.1, "low": 0.0, "high": 0.3}},
        "gap_closed": {"edge FL": ap},
    }


def test_summary_is_students_interval_over_seeds():
    aps = [0.40, 0.44, 0.36, 0.41, 0.39]
    summary = summarise([seed(ap) for ap in aps])
    low, high = stats.ttest_1samp(aps, 0.0).confidence_interval(0.95)
    for found in (summary["ap50"]["grid"]["pretrained"], summary["gap_closed"]["edge FL"]):
        assert (found["mean"], found["low"], found["high"]) == pytest.approx((np.mean(aps), low, high))
    assert summary["ap70"]["grid"]["edge FL"]["mean"] == pytest.approx(np.mean(aps) / 2)
    difference = summary["differences"]["grid: edge FL - pretrained"]
    assert (difference["low"], difference["high"]) == pytest.approx((0.1, 0.1))  # over seeds, not the scenes' own


def test_one_seed_has_no_interval():
    found = summarise([seed(0.4)])["ap50"]["grid"]["pretrained"]
    assert found == {"mean": 0.4, "low": 0.4, "high": 0.4}


def test_every_step_comes_after_what_it_needs():
    for scale in ("paper", "quick"):
        before: set[str] = set()
        for step in arm_steps(arms_protocol(1, scale)):
            assert set(step.needs) <= before, step.name
            assert step.name not in before
            before.add(step.name)


def test_the_committed_scale_tests_on_300_frames_or_more():
    assert arms_protocol(1, "paper").test.frames >= 300
