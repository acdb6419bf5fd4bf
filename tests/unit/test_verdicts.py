import pytest

from flcav.intervals import MeanOverSeeds
from flcav.verdicts import HELD, NOT_HELD, UNDECIDED, describe_aim, explain_verdict, signed, verdict


@pytest.mark.parametrize(
    ("low", "high", "at_most", "verdict"),
    [
        (0.85, 0.9, False, "reached"), (0.8, 0.849, False, "not reached"), (0.8, 0.9, False, "undecided"),
        (0.6, 0.85, True, "reached"), (0.86, 0.9, True, "not reached"), (0.8, 0.9, True, "undecided"),
    ],
)  # fmt: skip
def test_the_whole_interval_decides(low, high, at_most, verdict):
    reached = MeanOverSeeds((low + high) / 2, low, high)
    said = describe_aim("AP of 0.85", 0.85, reached, 3, at_most=at_most)
    assert said == f"*AP of 0.85*: **{verdict}**, {reached.mean:.3f} ({low:.3f} to {high:.3f}) over 3 seeds"


def test_one_seed_has_no_interval():
    reached = MeanOverSeeds(0.9, 0.9, 0.9)
    assert describe_aim("AP", 0.85, reached, 1) == "*AP*: **reached**, 0.900 of one seed"


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


def test_the_words_say_of_how_many_runs():
    assert explain_verdict(UNDECIDED) == "the interval contains 0, so this run does not decide"
    assert explain_verdict(UNDECIDED, 3) == "the interval contains 0, so these runs do not decide"
    assert explain_verdict(NOT_HELD, 3) == "the interval lies below 0, so the claim did not hold"
    assert (signed(-0.0125), signed(2, 1)) == ("−0.013", "+2.0")
