import pytest

from flcav.experiments.aims import aim_sentence


@pytest.mark.parametrize(
    ("low", "high", "at_most", "verdict"),
    [
        (0.85, 0.9, False, "reached"), (0.8, 0.849, False, "not reached"), (0.8, 0.9, False, "undecided"),
        (0.6, 0.85, True, "reached"), (0.86, 0.9, True, "not reached"), (0.8, 0.9, True, "undecided"),
    ],
)  # fmt: skip
def test_the_whole_interval_decides(low, high, at_most, verdict):
    reached = {"mean": (low + high) / 2, "low": low, "high": high}
    said = aim_sentence("AP of 0.85", 0.85, reached, 3, at_most=at_most)
    assert said == f"*AP of 0.85*: **{verdict}**, {reached['mean']:.3f} ({low:.3f} to {high:.3f}) over 3 seeds"


def test_one_seed_has_no_interval():
    reached = {"mean": 0.9, "low": 0.9, "high": 0.9}
    assert aim_sentence("AP", 0.85, reached, 1) == "*AP*: **reached**, 0.900 of one seed"
