import pytest

from flcav.intervals import Estimate, Spread, of_one_training
from flcav.verdicts import HELD, NOT_HELD, UNDECIDED, Claim, explain_verdict, judge, judge_known, signed, verdict


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
    assert explain_verdict(UNDECIDED) == "this run does not decide"
    assert explain_verdict(NOT_HELD) == "the claim did not hold in this run"
    assert (signed(-0.0125), signed(2, 1)) == ("−0.013", "+2.0")
